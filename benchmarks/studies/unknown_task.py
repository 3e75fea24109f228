"""Detection of a task that was never shown, by the novelty of its demonstrations.

python benchmarks/studies/unknown_task.py --tasks all --draws 1600
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from scipy import stats
from torch import Tensor

from bgpo_trl.analysis.tables import Table, markdown
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.experiments.arguments import BankArguments
from bgpo_trl.experiments.command_line import command_line
from bgpo_trl.experiments.run import bank_of
from bgpo_trl.experiments.settings import check_draws
from bgpo_trl.figures.style import COLORS, LINES, save_figure, style_axes
from bgpo_trl.files.writing import check_folder, write_json
from bgpo_trl.modules.behavior_groups import BehaviorGroups
from bgpo_trl.seeding import generators


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


if __name__ == "__main__":
    command_line(unknown_task)
