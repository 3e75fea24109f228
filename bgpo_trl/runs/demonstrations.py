"""Encoders and demonstrations of a run: kept in its directory and found again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.encoders.pretrained import bank_path, find_weights
from bgpo_trl.encoders.representation import (
    Representation,
    load_representation,
)
from bgpo_trl.runs.config_file import Digests
from suites import nico

BANK = "bank.safetensors"
"""File of a run directory that holds its demonstrations, unless they come with its encoders."""


def keep_bank(directory: Path, bank: DemonstrationBank, encoders: Representation) -> None:
    """Store the demonstrations of a run, unless they are there already or come with its encoders.

    A copy, of at most a few megabytes, moves with the directory to other machines. Runs with the
    shipped demonstrations store none, since their digest in ``config.json`` identifies them.

    Args:
        directory: The run directory.
        bank: Demonstrations of the run's tasks.
        encoders: Encoders of the run.

    Raises:
        OSError: If the file cannot be written.
    """
    for path in (directory / BANK, bank_path(_weights(directory, encoders.identity))):
        try:
            there = DemonstrationBank.load(path, encoder_id=encoders.identity)
            if there.for_tasks(bank.tasks).identity == bank.identity:
                return
        except ValueError:  # missing, damaged, of other encoders or of other tasks
            continue
    replace(bank, encoder_id=encoders.identity).save(directory / BANK)


def load_inputs(
    directory: Path, tasks: tuple[str, ...], digests: Digests
) -> tuple[Representation, DemonstrationBank]:
    """Load the encoders and demonstrations that a run was trained with.

    Args:
        directory: The run directory.
        tasks: Tasks of the run.
        digests: Digests in its ``config.json``.

    Raises:
        ValueError: If one of the files is missing, damaged or another one.
    """
    own, weights = _own_weights(directory), _weights(directory, digests.encoders)
    encoders = load_representation(weights, scene_version=nico.scene_version())
    if encoders.identity != digests.encoders:
        present = own if own == weights else "those that come with the package"
        raise ValueError(
            f"{directory} was trained with the encoders {str(digests.encoders)[:12]}, not with "
            f"{present} ({encoders.identity[:12]}): put its own at {own}"
        )
    kept = directory / BANK
    path = kept if kept.exists() else bank_path(weights)
    bank = DemonstrationBank.load(path, encoder_id=encoders.identity).for_tasks(tasks)
    if digests.bank not in (None, bank.identity):  # None: of an earlier version
        raise ValueError(
            f"{directory} was trained with the demonstrations {digests.bank[:12]}, not with those "
            f"in {path} ({bank.identity[:12]}): put its own at {kept}"
        )
    return encoders, bank


def _own_weights(directory: Path) -> Path:
    return directory / "encoders" / "nico.safetensors"


def _weights(directory: Path, identity: str | None) -> Path:
    """Return the path of a run's encoders: its own if it has some, else shipped ones."""
    own = _own_weights(directory)
    return own if own.exists() else find_weights(identity)
