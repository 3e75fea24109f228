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


def distinctness(bank: DemonstrationBank) -> tuple[bool, str]:
    """Measure how well embeddings tell the last of a bank's two or more tasks from the others.

    At most 300 demonstrations of each task are compared with their nearest other demonstration.

    Returns:
        Whether the last task is told apart about as well as the others were without it, and a line
        with the measurements and the verdict.
    """
    last = len(bank.tasks) - 1
    rows = torch.cat([torch.nonzero(bank.task == t).flatten()[:_MOST] for t in range(last + 1)])
    phi, task = bank.embedding[rows], bank.task[rows]
    distance = torch.cdist(phi, phi).fill_diagonal_(torch.inf)
    is_new = task == last
    nearest = task[distance.argmin(1)]
    nearest_old = task[distance.masked_fill(is_new, torch.inf).argmin(1)]
    new = float((nearest == task)[is_new].float().mean())
    # With one old task, no old demonstration could have been mistaken.
    old = float((nearest_old == task)[~is_new].float().mean())
    clear = new >= old - _CONFUSED
    verdict = "the encoders tell the new task from the others"
    if not clear:
        confused = bank.tasks[int(nearest[is_new & (nearest != task)].mode().values)]
        verdict = (
            f"the encoders confuse the new task with {confused}: a new run with encoders that are "
            "trained on it too (bgpo encoders) would learn it better"
        )
    return clear, (
        f"nearest demonstration of the same task: {new:.0%} of the new demonstrations, {old:.0%} "
        f"of the old; {verdict}"
    )
