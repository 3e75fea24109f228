"""Encoders with their demonstration bank, in files beside each other; the shipped ones by default.

Two pairs come with the package: that of the paper's three tasks, with which all results on these
tasks were made, and that of the suite's eight tasks.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from importlib import resources
from pathlib import Path

from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.encoders.representation import Representation, load_representation
from bgpo_trl.files.tensor_file import load_tensors
from suites import nico

_PAPER, _EIGHT = "nico.safetensors", "nico_eight.safetensors"


def load_pretrained(
    weights: str | Path | None = None, *, tasks: Sequence[str] = nico.PAPER_TASKS
) -> tuple[Representation, DemonstrationBank]:
    """Load encoders and the bank beside them.

    Args:
        weights: File of the encoders; by default the shipped ones for ``tasks``, see
            `default_weights`.
        tasks: Names of tasks.

    Raises:
        ValueError: If either file is missing, damaged or was made for another scene.
    """
    weights = default_weights(tasks) if weights is None else Path(weights)
    encoders = load_representation(weights, scene_version=nico.scene_version())
    bank = DemonstrationBank.load(bank_path(weights), encoder_id=encoders.identity)
    return encoders, bank


def default_weights(tasks: Sequence[str] = nico.PAPER_TASKS) -> Path:
    """Return the path of the shipped encoders for some tasks.

    These are the encoders of eight tasks if one of the suite's further five is among them, and
    otherwise, also for custom tasks, those of the paper's three.
    """
    further = set(nico.ALL_TASKS) - set(nico.PAPER_TASKS)
    return _path(_PAPER if further.isdisjoint(tasks) else _EIGHT)


def bank_path(weights: Path) -> Path:
    """Return the path of the bank beside encoder weights, such as ``nico_bank.safetensors``."""
    return weights.with_name(f"{weights.stem}_bank{weights.suffix}")


def find_weights(identity: str | None) -> Path:
    """Return the path of the shipped encoders with an identity.

    Falls back to the encoders of the paper's tasks if no shipped ones have this identity.
    """
    return _path(_EIGHT if identity is not None and identity == _identity(_EIGHT) else _PAPER)


def weights_of_bank(bank: Path) -> Path:
    """Return the path of the shipped encoders that embedded a bank.

    Falls back to the encoders of the paper's tasks if others embedded it, or it cannot be read.
    """
    try:
        metadata = load_tensors(bank)[1]
    except (FileNotFoundError, ValueError):
        metadata = {}
    return find_weights(metadata.get("encoder_id"))


@cache
def _identity(name: str) -> str | None:
    """Return the identity of shipped encoders; None if they are not there."""
    path = _path(name)
    return load_representation(path).identity if path.exists() else None


def _path(name: str) -> Path:
    return Path(str(resources.files("bgpo_trl") / "weights" / name))
