"""Encoders with their demonstration bank, in files beside each other; the shipped ones by default.

Two pairs come with the package: that of the paper's three tasks, with which all results on these
tasks were made, and that of the suite's eight tasks.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path

from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.encoders.representation import Representation, load_representation
from bgpo_trl.files.tensor_file import load_tensors
from bgpo_trl.scenes import Scene, find_scene


def load_pretrained(
    weights: str | Path | None = None,
    *,
    tasks: Sequence[str] | None = None,
    scene: Scene | str = "nico",
) -> tuple[Representation, DemonstrationBank]:
    """Load encoders and the bank beside them.

    Args:
        weights: File of the encoders; by default the shipped ones for ``tasks``, see
            `default_weights`.
        tasks: Names of tasks; by default the scene's.
        scene: The robot, or its name.

    Raises:
        ValueError: If either file is missing, damaged or was made for another scene.
    """
    scene = find_scene(scene)
    weights = default_weights(tasks, scene=scene) if weights is None else Path(weights)
    encoders = load_representation(weights, scene=scene)
    path = bank_path(weights)
    bank = DemonstrationBank.load(path, encoder_id=encoders.identity)
    if bank.scene is not None:
        scene.check_identity(bank.scene, path, "record and embed demonstrations of this scene")
    return encoders, bank


def default_weights(tasks: Sequence[str] | None = None, *, scene: Scene | str = "nico") -> Path:
    """Return the path of the encoders that come with a scene: the first with the most of the tasks.

    For NICO, they are the encoders of eight tasks if one of the suite's further five is among them,
    and otherwise, also for custom tasks, those of the paper's three.

    Raises:
        ValueError: If none come with the scene.
    """
    scene = find_scene(scene)
    if not scene.weights:
        raise ValueError(
            f"no encoders come with the scene {scene.name!r}: name a file (--encoders, --weights "
            "in the commands of bgpo_trl.encoders), or let a run train some (--train-encoders)"
        )
    wanted = {*(scene.default_tasks if tasks is None else tasks)}
    return max(scene.weights, key=lambda path: len(wanted.intersection(scene.weights[path])))


def bank_path(weights: Path) -> Path:
    """Return the path of the bank beside encoder weights, such as ``nico_bank.safetensors``."""
    return weights.with_name(f"{weights.stem}_bank{weights.suffix}")


def find_weights(identity: str | None, scene: Scene | str = "nico") -> Path | None:
    """Return the path of the encoders with an identity that come with a scene; None if none do."""
    files = [path for path in find_scene(scene).weights if path.exists()]
    return next((path for path in files if identity == _identity(path)), None)


def weights_of_bank(bank: Path, scene: Scene | str = "nico") -> Path:
    """Return the path of the encoders of a scene that embedded a bank.

    Falls back to those of its usual tasks if others embedded it, or it cannot be read.
    """
    try:
        metadata = load_tensors(bank)[1]
    except (FileNotFoundError, ValueError):
        metadata = {}
    return find_weights(metadata.get("encoder_id"), scene) or default_weights(scene=scene)


@cache
def _identity(path: Path) -> str:
    """Return the identity of shipped encoders."""
    return load_representation(path).identity
