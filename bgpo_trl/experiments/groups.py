"""Groups of behaviors that form from demonstrations: their purity, and tasks new to them."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from bgpo_trl.analysis.tables import Table, markdown
from bgpo_trl.analysis.task_inference import group_purity, task_inference_accuracy
from bgpo_trl.configs import BGPOConfig
from bgpo_trl.experiments.arguments import BankArguments
from bgpo_trl.experiments.settings import check_draws, even_starts
from bgpo_trl.figures.style import COLORS, LINES, save_figure, style_axes
from bgpo_trl.files.writing import check_folder, write_json
from bgpo_trl.seeding import generators

if TYPE_CHECKING:
    from bgpo_trl.data.bank import DemonstrationBank
    from bgpo_trl.modules.behavior_groups import BehaviorGroups
    from bgpo_trl.transforms import TaskSchedule


@dataclass(frozen=True)
class GroupsArguments(BankArguments):
    """Demonstrations that groups form from."""

    draws: int = 1_800
    """Demonstrations that each network is shown."""
    activity_scale: float = BGPOConfig().gwr.activity_scale
    """Factor of distances in the activity of GWR-B."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Seeds of the draws."""


def draw(bank: DemonstrationBank, schedule: TaskSchedule, draws: int, seed: int) -> Iterator[int]:
    """Draw demonstrations as training episodes do: rows of the bank."""
    of_task = [np.flatnonzero(bank.task == task) for task in range(schedule.n_tasks)]
    rng = np.random.default_rng(seed)
    for available in schedule.available(torch.arange(draws)):
        yield int(rng.choice(of_task[rng.choice(available.nonzero().flatten())]))


def own_groups(group: Tensor, task: Tensor) -> set[int]:
    """Return the tasks most of whose demonstrations are in a group that holds mostly theirs."""
    counts = _counts(group, task)
    largest = counts.argmax(0)
    is_own = counts[largest].argmax(-1) == torch.arange(len(largest))
    return {*(is_own & (counts.sum(0) > 0)).nonzero().flatten().tolist()}


def sharing(group: Tensor, task: Tensor) -> set[tuple[int, int]]:
    """Return the pairs of tasks of which one group holds more than a tenth each."""
    counts = _counts(group, task)
    held = counts / counts.sum(0).clamp(min=1) > 0.1
    return {pair for row in held for pair in combinations(row.nonzero().flatten().tolist(), 2)}


def _counts(group: Tensor, task: Tensor) -> Tensor:
    """Return the number of demonstrations by group and task, ``[G, T]``."""
    counts = torch.zeros(int(group.max()) + 1, int(task.max()) + 1)
    return counts.index_put_((group, task), torch.tensor(1.0), accumulate=True)


def form(
    bank: DemonstrationBank, rows: Sequence[int], config: BGPOConfig
) -> tuple[BehaviorGroups, dict[int, int], float]:
    """Let groups form.

    Returns:
        The groups; by task, the number of its different demonstrations when it first had a group of
        its own; seconds.
    """
    from bgpo_trl.modules.behavior_groups import BehaviorGroups

    groups = BehaviorGroups(
        bank.embedding.shape[-1], smallest=config.group_size, evidence=config.group_evidence
    )
    shown: dict[int, None] = {}
    needed: dict[int, int] = {}
    seconds, revision = 0.0, -1
    for row in rows:
        shown[row] = None
        begun = time.perf_counter()
        groups.adapt(bank.embedding[row])
        seconds += time.perf_counter() - begun
        if groups.revision == revision:
            continue
        revision = groups.revision
        so_far = torch.tensor([*shown])
        task = bank.task[so_far]
        for own in own_groups(groups.lookup(bank.embedding[so_far]).group, task) - needed.keys():
            needed[own] = int((task == own).sum())
    return groups, needed, seconds


def groups(arguments: GroupsArguments) -> str:
    """Measure the groups of behaviors that form from demonstrations, without learning a policy.

    Shows demonstrations in the order of training episodes, in four schedules, and prints by seed:
    how many groups there are at the end; how pure they are on held-out demonstrations; how many
    different demonstrations of its own each task needed before it had a group (the most demanding
    task); how long grouping took; the nodes of GWR-B, and in how many held-out demonstrations it
    infers the task. Below the table are the tasks that share a group (`sharing`, of held-out
    demonstrations), with the number of networks in which they do.

    Raises:
        ValueError: If there is nothing to draw, or a bank or task does not exist.
    """
    torch.set_num_threads(1)
    from bgpo_trl.experiments.run import bank_of
    from bgpo_trl.modules.gwr import GWRB
    from bgpo_trl.transforms import TaskSchedule

    check_draws(arguments.seeds, arguments.draws)
    bank, config = bank_of(arguments), BGPOConfig()
    fine = replace(config.gwr, activity_scale=arguments.activity_scale)
    n_tasks, seen, held_out = len(bank.tasks), bank.seen(), bank.held_out()
    forward = even_starts(n_tasks, arguments.draws)
    schedules = {
        "one after the other": TaskSchedule(forward),
        "in reverse": TaskSchedule(forward[::-1]),
        "the newest only": TaskSchedule(forward, cumulative=False),
        "from the start": TaskSchedule((0,) * n_tasks),
    }
    table: Table = [
        ["order", "groups, by seed", "purity, %", "needed", "seconds", "nodes", "inferred, %"]
    ]
    shared: Counter[tuple[int, int]] = Counter()
    for order, schedule in schedules.items():
        columns: list[list[str]] = []
        for seed in arguments.seeds:
            rows = [*draw(seen, schedule, arguments.draws, seed)]
            formed, needed, seconds = form(seen, rows, config)
            shared.update(sharing(formed.lookup(held_out.embedding).group, held_out.task))
            (random,) = generators([seed], "gwr")
            gwr = GWRB(seen.embedding.shape[-1], fine, generator=random)
            for row in rows:
                gwr.adapt(seen.embedding[row])
            inferred = task_inference_accuracy(gwr, seen, held_out, n_tasks)
            columns.append(
                [
                    f"{len(formed.numbers)}",
                    f"{100 * group_purity(formed, held_out, n_tasks):.4g}",
                    f"{max(needed.values())}" if len(needed) == n_tasks else "never",
                    f"{seconds:.1f}",
                    f"{int(gwr.num_nodes)}",
                    f"{100 * float(inferred):.4g}",
                ]
            )
        table.append([order, *(" ".join(column) for column in zip(*columns, strict=True))])
    n_networks = len(schedules) * len(arguments.seeds)
    lines = [
        f"{bank.tasks[one]} and {bank.tasks[other]} share a group in {count} of {n_networks}."
        for (one, other), count in shared.most_common()
    ]
    return "\n".join([markdown(table), "", *lines]).rstrip()


@dataclass(frozen=True)
class Detection:
    """Novelty of held-out demonstrations to the groups of networks that never saw one task.

    Attributes:
        known: Novelties of demonstrations of the other tasks, ``[S, K]`` for ``S`` networks.
        unknown: Novelties of demonstrations of the task left out, ``[S, U]``.
    """

    known: Tensor
    unknown: Tensor

    @property
    def area(self) -> Tensor:
        """Area under the ROC curve of each network, ``[S]``; see `roc_area`."""
        pairs = zip(self.known, self.unknown, strict=True)
        return torch.stack([roc_area(known, unknown) for known, unknown in pairs])

    @property
    def detected(self) -> Tensor:
        """Share of the unknown that belongs to no known group, ``[S]``."""
        return (self.unknown > 1).float().mean(-1)

    @property
    def false_alarms(self) -> Tensor:
        """Share of the known that belongs to no known group, ``[S]``."""
        return (self.known > 1).float().mean(-1)


def roc_area(known: Tensor, unknown: Tensor) -> Tensor:
    """Return the area under the ROC curve of "unknown if the novelty is high", ``[]``.

    It is the probability that a demonstration of the unknown is newer than one of the known
    (Mann and Whitney, 1947); equal novelties count half.

    Args:
        known: Novelties ``[K]``.
        unknown: Novelties ``[U]``.
    """
    from scipy import stats

    wins = stats.mannwhitneyu(unknown, known).statistic
    return torch.tensor(wins / (len(known) * len(unknown)))


def roc_curve(known: Tensor, unknown: Tensor) -> tuple[Tensor, Tensor]:
    """Return the ROC curve as shares ``[P]`` of false alarms and of detections, from 0 to 1.

    A point is a threshold: each of the novelties ``known`` ``[K]`` and ``unknown`` ``[U]``, and
    one above all of them.
    """
    thresholds = torch.cat([known, unknown]).unique().flip(0)
    above = [(values >= thresholds.unsqueeze(-1)).float().mean(-1) for values in (known, unknown)]
    false_alarms, detected = (torch.nn.functional.pad(share, (1, 0)) for share in above)
    return false_alarms, detected


@torch.no_grad()
def leave_one_out(
    bank: DemonstrationBank,
    task: int,
    *,
    seeds: Sequence[int],
    draws: int = 600,
) -> Detection:
    """Let groups form without one task, and measure the novelty of demonstrations of all tasks.

    Args:
        bank: Demonstrations, seen and held out, of at least two tasks.
        task: Label of the task to leave out.
        seeds: Seeds of the draws, one for each of ``S`` networks.
        draws: Demonstrations that each network learns from, drawn with replacement.

    Raises:
        ValueError: If the bank has no demonstration of another task to learn from or to test on, or
            none held out of the task.
    """
    seen, held_out = bank.seen(), bank.held_out()
    learned = seen.embedding[seen.task != task]
    known = held_out.embedding[held_out.task != task]
    unknown = held_out.embedding[held_out.task == task]
    if not len(learned) or not len(known) or not len(unknown):
        raise ValueError(
            f"leaving out task {task} takes demonstrations of it that are held out, and others "
            "both to learn from and held out: the bank lacks some"
        )
    from bgpo_trl.modules.behavior_groups import BehaviorGroups

    of_known, of_unknown = [], []
    for stream in generators(seeds, "leave one out"):
        groups = BehaviorGroups(learned.shape[-1])
        for phi in learned[torch.randint(len(learned), (draws,), generator=stream)]:
            groups.adapt(phi)
        of_known.append(groups.lookup(known).novelty)
        of_unknown.append(groups.lookup(unknown).novelty)
    return Detection(torch.stack(of_known), torch.stack(of_unknown))


@dataclass(frozen=True)
class UnknownTaskArguments(BankArguments):
    """Demonstrations to leave out."""

    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Seeds of the draws of demonstrations."""
    draws: int = 600
    """Demonstrations that the groups form from."""
    out: Path = Path("runs/unknown-task")
    """Folder of the results."""


def draw_roc(found: dict[str, Detection]) -> Figure:
    """Draw the ROC curve of each task, of all seeds together."""
    figure = Figure(figsize=(3.6, 3.4), layout="constrained")
    axes = figure.add_subplot()
    for i, (task, detection) in enumerate(found.items()):
        curve = roc_curve(detection.known.flatten(), detection.unknown.flatten())
        color, line = COLORS[i % len(COLORS)], LINES[i % len(LINES)]
        axes.plot(*curve, color=color, linestyle=line, label=task.replace("_", " "))
    axes.plot([0, 1], [0, 1], color="0.7", linewidth=0.8)
    axes.set_xlabel("known tasks taken for unknown", fontsize=9)
    axes.set_ylabel("unknown task detected", fontsize=9)
    axes.legend(title="left out", fontsize=7, title_fontsize=8, frameon=False)
    style_axes(axes)
    return figure


def unknown_task(arguments: UnknownTaskArguments) -> str:
    """Measure how well demonstrations of a task that was never shown are detected.

    Leaves out each task in turn: groups form from demonstrations of the others, and the novelty of
    held-out demonstrations says whether their task is known. Prints a table and writes
    unknown_task.json and the ROC curves, roc.png.

    Raises:
        ValueError: If there is nothing to draw, or a bank or task does not exist.
    """
    from bgpo_trl.experiments.run import bank_of

    check_draws(arguments.seeds, arguments.draws)
    check_folder(arguments.out)
    bank = bank_of(arguments)
    if len(bank.tasks) < 2:
        raise ValueError("--tasks: name at least two, of which each is left out in turn")
    found = {
        task: leave_one_out(bank, i, seeds=arguments.seeds, draws=arguments.draws)
        for i, task in enumerate(bank.tasks)
    }
    table: Table = [["left out", "area under the ROC curve, by seed", "detected, %"]]
    table[0].append("false alarms, %")
    results = {}
    for task, detection in found.items():
        area = detection.area.tolist()
        shares = [100 * float(s.mean()) for s in (detection.detected, detection.false_alarms)]
        results[task] = {"area": area, "detected": shares[0], "false_alarms": shares[1]}
        by_seed = " ".join(f"{value:.3f}" for value in area)
        table.append([task, by_seed, *(f"{share:.1f}" for share in shares)])
    mean = np.mean([result["area"] for result in results.values()])
    save_figure(draw_roc(found), arguments.out / "roc.png")
    write_json(arguments.out / "unknown_task.json", results)
    return f"{markdown(table)}\n\nMean area {mean:.3f}."
