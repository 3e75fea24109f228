"""Trained encoders with their demonstration bank: load the pretrained ones, or train new ones."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch

from bgpo_trl.configs import RepresentationConfig
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.data.recording import record_demonstrations
from bgpo_trl.encoders.representation import (
    Representation,
    load_representation,
)
from bgpo_trl.encoders.shipped import bank_path, default_weights
from bgpo_trl.encoders.train import train_encoders
from suites import nico


def load_pretrained(
    weights: str | Path | None = None, *, tasks: Sequence[str] = nico.PAPER_TASKS
) -> tuple[Representation, DemonstrationBank]:
    """Load encoders and the bank beside them.

    Args:
        weights: File of the encoders; by default the shipped ones for ``tasks``, see
            `bgpo_trl.encoders.shipped.default_weights`.
        tasks: Names of tasks.

    Raises:
        ValueError: If either file is missing, damaged or was made for another scene.
    """
    weights = default_weights(tasks) if weights is None else Path(weights)
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
    tasks: Sequence[str] = nico.PAPER_TASKS,
    spread: float = 1.0,
) -> tuple[Representation, DemonstrationBank]:
    """Record demonstrations and play, train both encoders, and embed the demonstrations.

    Each interrupted stage is resumed.

    Args:
        weights: File to write the encoders to; the bank is written beside it.
        dataset: Folder of the demonstrations, recorded if missing. Half as many episodes of play go
            to the folder of the same name plus ``-play``.
        folder: Folder for the training log, checkpoints and probes.
        config: Hyperparameters of the encoders.
        per_task: Demonstrations of each task.
        held_out_per_task: How many of those are held out.
        seed: Seed of the recording.
        command: Command line, stored with the weights.
        progress: Whether to show progress bars.
        device: Device to train on.
        tasks: Tasks to demonstrate.
        spread: Share of the whole range of start states.

    Raises:
        ValueError: If the dataset is damaged or was recorded in another scene.
    """
    record = partial(
        record_demonstrations, tasks=tasks, spread=spread, seed=seed, progress=progress
    )
    demonstrations = record(dataset, per_task=per_task, held_out_per_task=held_out_per_task)
    play = record(
        Path(dataset).with_name(f"{Path(dataset).name}-play"),
        per_task=max(2, per_task // 2),
        held_out_per_task=max(1, held_out_per_task // 4),
        play=True,
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
        spread=spread,
    )
