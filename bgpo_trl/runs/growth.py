"""A further task for a run that has begun, and whether its encoders tell the task from others."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch

from bgpo_trl.configs import RunConfig
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.encoders.pretrained import bank_path
from bgpo_trl.encoders.representation import Representation
from bgpo_trl.runs.config_file import read_config, settings_of
from bgpo_trl.runs.demonstrations import load_inputs, weights_of_run
from bgpo_trl.runs.directory import read_checkpoint
from bgpo_trl.scenes import find_scene

_MOST = 300  # demonstrations of a task that are compared
_CONFUSED = 0.1  # by how much fewer demonstrations may be nearest to their own task


class Grown(NamedTuple):
    """Arguments with which `Trainer` resumes a run that has got a further task."""

    config: RunConfig
    encoders: Representation
    bank: DemonstrationBank


def add_task(
    directory: str | Path,
    task: str,
    *,
    config: RunConfig | None = None,
    bank: str | Path | None = None,
) -> Grown:
    """Return what a run goes on with after it has got a further task; write nothing.

    ``Trainer(grown.config, directory, bank=grown.bank, encoders=grown.encoders, resume=True)`` goes
    on from the last checkpoint. The task is presented from the first episode that no seed has
    begun. Seeds alone equal those of a batch if the task starts at the same episode.

    Args:
        directory: The run, finished or not.
        task: Name of a task of its scene.
        config: Settings of the run, by default those in the directory, with more ``episodes`` if it
            is to play longer.
        bank: Demonstrations of the task, embedded by the run's encoders; by default those beside
            the encoders.

    Raises:
        ValueError: If the run has no checkpoint, its files are missing or damaged, the scene has no
            such task, the run has it, there is no demonstration of it, or the run ends before.
    """
    directory = Path(directory)
    saved, digests = read_config(directory / "config.json")
    config, scene = saved if config is None else config, find_scene(saved.scene)
    if task in saved.tasks:
        raise ValueError(f"{directory} has the task {task!r} already: resume it without adding one")
    scene.check_tasks((task,))
    encoders, shown = load_inputs(directory, saved.tasks, digests, scene)
    weights = weights_of_run(directory, scene, encoders.identity)
    assert weights is not None  # `load_inputs` has found them.
    path = bank_path(weights) if bank is None else bank
    found = DemonstrationBank.load(path, encoder_id=encoders.identity)
    shown += found.for_tasks((task,))
    state = read_checkpoint(directory, settings_of(saved, digests), mmap=True)
    start = int(state["world"]["source"]["episode"].max()) + 1
    if start >= config.episodes:
        raise ValueError(
            f"{directory} would end after {config.episodes} episodes, before {task!r} can start at "
            f"episode {start}: choose more (--episodes)"
        )
    grown = replace(config, tasks=(*config.tasks, task), task_starts=(*config.task_starts, start))
    return Grown(grown, encoders, shown)


class Distinctness(NamedTuple):
    """How well embeddings tell the last task of a bank from the others.

    Attributes:
        new: Share of its demonstrations whose nearest other demonstration is of the same task.
        old: The same of the other tasks, before it was added.
        confused: The task that most of the mistaken demonstrations are nearest to; None without
            such ones.
    """

    new: float
    old: float
    confused: str | None

    @property
    def clear(self) -> bool:
        """Whether the last task is told apart about as well as the others."""
        return self.new >= self.old - _CONFUSED

    def __str__(self) -> str:
        """Return the measurements and the verdict in a line."""
        verdict = (
            "the encoders tell the new task from the others"
            if self.clear
            else f"the encoders confuse the new task with {self.confused}: a new run with encoders "
            "that are trained on it too (bgpo encoders) would learn it better"
        )
        return (
            f"nearest demonstration of the same task: {self.new:.0%} of the new demonstrations, "
            f"{self.old:.0%} of the old; {verdict}"
        )


def distinctness(bank: DemonstrationBank) -> Distinctness:
    """Measure whether encoders see the last of a bank's two or more tasks.

    At most 300 demonstrations of each are compared.
    """
    last = len(bank.tasks) - 1
    rows = torch.cat([torch.nonzero(bank.task == t).flatten()[:_MOST] for t in range(last + 1)])
    phi, task = bank.embedding[rows], bank.task[rows]
    distance = torch.cdist(phi, phi).fill_diagonal_(torch.inf)
    is_new = task == last
    nearest = task[distance.argmin(1)]
    nearest_old = task[distance.masked_fill(is_new, torch.inf).argmin(1)]
    mistaken = nearest[is_new & (nearest != task)]
    # With one old task, no old demonstration could have been mistaken.
    return Distinctness(
        new=float((nearest == task)[is_new].float().mean()),
        old=float((nearest_old == task)[~is_new].float().mean()),
        confused=bank.tasks[int(mistaken.mode().values)] if len(mistaken) else None,
    )
