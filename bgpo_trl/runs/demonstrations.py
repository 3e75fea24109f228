"""Encoders and demonstrations of a run: kept in its directory and found again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.encoders.pretrained import bank_path, find_weights
from bgpo_trl.encoders.representation import (
    Representation,
    load_representation,
    save_representation,
)
from bgpo_trl.runs.config_file import Digests
from bgpo_trl.scenes import Scene, find_scene

BANK = "bank.safetensors"
"""File of a run directory that holds its demonstrations, unless they come with its encoders."""


def keep_inputs(
    directory: Path,
    bank: DemonstrationBank,
    encoders: Representation,
    scene: Scene | str = "nico",
) -> None:
    """Store encoders and demonstrations of a run, unless they are there or come with the scene.

    Copies, of some megabytes, move with the directory to other machines. Runs with the shipped
    encoders and demonstrations store none, since digests in ``config.json`` identify them.

    Raises:
        OSError: If a file cannot be written.
    """
    weights = weights_of_run(directory, scene, encoders.identity)
    if weights is None:
        weights = own_weights(directory)
        save_representation(encoders, weights)
    kept = directory / BANK
    try:
        path = kept if kept.exists() else bank_path(weights)
        there = DemonstrationBank.load(path, encoder_id=encoders.identity)
        if there.for_tasks(bank.tasks).identity == bank.identity:
            return
    except ValueError:  # missing, damaged, of other encoders, or without tasks added since
        pass
    bank = replace(bank, encoder_id=encoders.identity, scene=find_scene(scene).identity)
    bank.save(kept)


def load_inputs(
    directory: Path, tasks: tuple[str, ...], digests: Digests, scene: Scene | str = "nico"
) -> tuple[Representation, DemonstrationBank]:
    """Load the encoders and demonstrations that a run was trained with.

    Raises:
        ValueError: If one of the files is missing, damaged or another one.
    """
    weights = weights_of_run(directory, scene, digests.encoders)
    if weights is None:
        raise ValueError(
            f"{directory} was trained with the encoders {str(digests.encoders)[:12]}, which do not "
            f"come with the scene: put them at {own_weights(directory)}"
        )
    encoders = load_representation(weights)
    if encoders.identity != digests.encoders:
        raise ValueError(
            f"{directory} was trained with the encoders {str(digests.encoders)[:12]}, not with "
            f"{weights} ({encoders.identity[:12]}): put its own there"
        )
    remedy = "use the version of the scene that it was trained in"
    encoders.check_scene(find_scene(scene), directory, remedy)
    kept = directory / BANK
    path = kept if kept.exists() else bank_path(weights)
    bank = DemonstrationBank.load(path, encoder_id=encoders.identity).for_tasks(tasks)
    if digests.bank != bank.identity:
        raise ValueError(
            f"{directory} was trained with the demonstrations {str(digests.bank)[:12]}, not with "
            f"those in {path} ({bank.identity[:12]}): put its own at {kept}"
        )
    return encoders, bank


def own_weights(directory: Path) -> Path:
    """Return the path of encoders that a run does not share with others."""
    return directory / "encoders" / "encoders.safetensors"


def weights_of_run(directory: Path, scene: Scene | str, identity: str | None) -> Path | None:
    """Return the path of a run's encoders: its own if it has some, else those of the scene."""
    own = own_weights(directory)
    return own if own.exists() else find_weights(identity, scene)
