"""Trained encoders and the bank of embedded demonstrations: load those shipped, or make new."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch

from bgpo_trl.configs import RepresentationConfig
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.data.recording import record_demonstrations
from bgpo_trl.encoders.representation import (
    Representation,
    bank_path,
    default_weights,
    load_representation,
)
from bgpo_trl.encoders.train import train_encoders
from suites import nico


def load_pretrained(
    weights: str | Path | None = None,
) -> tuple[Representation, DemonstrationBank]:
    """Loads encoders and the bank that lies beside them.

    Args:
        weights: Encoder weights; those that come with the package if None.

    Raises:
        ValueError: If either is missing, damaged or made for another scene.
    """
    weights = default_weights() if weights is None else Path(weights)
    encoders = load_representation(weights, scene_version=nico.scene_version())
    bank = DemonstrationBank.load(bank_path(weights), encoder_id=encoders.identity)
    return encoders, bank


def make_pretrained(
    weights: str | Path,
    dataset: str | Path,
    *,
    folder: str | Path,
    config: RepresentationConfig | None = None,
    per_task: int = 1_200,
    held_out_per_task: int = 200,
    seed: int = 0,
    command: str = "",
    progress: bool = True,
    device: torch.device | str = "cpu",
    tasks: Sequence[str] = nico.ALL_TASKS,
) -> tuple[Representation, DemonstrationBank]:
    """Records demonstrations and play, trains both encoders, and embeds the demonstrations.

    Each stage continues where it was interrupted.

    Args:
        weights: Where to write the encoders; the bank goes beside them.
        dataset: Folder of the demonstrations; recorded if not there yet. Half as many episodes of
            play go to the folder of that name with ``-play`` at its end.
        folder: Folder for the log, checkpoints and probes of the training.
        config: Hyperparameters of the encoders.
        per_task: Demonstrations of each task.
        held_out_per_task: How many of those are held out.
        seed: Seed of the recording.
        command: Stored with the weights.
        progress: Whether to show progress bars.
        device: Where to train.
        tasks: Tasks to demonstrate.

    Raises:
        ValueError: If the dataset is damaged or of another scene.
    """
    demonstrations = record_demonstrations(
        dataset,
        tasks=tasks,
        per_task=per_task,
        held_out_per_task=held_out_per_task,
        seed=seed,
        progress=progress,
    )
    folder_of_play = Path(dataset).with_name(f"{Path(dataset).name}-play")
    play = record_demonstrations(
        folder_of_play,
        tasks=tasks,
        per_task=max(2, per_task // 2),
        held_out_per_task=max(1, held_out_per_task // 4),
        play=True,
        seed=seed,
        progress=progress,
    )
    return train_encoders(
        demonstrations,
        play,
        Path(weights),
        Path(folder),
        config or RepresentationConfig(),
        command,
        device,
        progress=progress,
        tasks=tasks,
    )
