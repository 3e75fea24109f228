"""Detection of a task that was never shown, by its novelty to the groups of behaviors."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from bgpo_trl.analysis.novelty import Detection, leave_one_out, roc_curve
from bgpo_trl.analysis.tables import Table, markdown
from bgpo_trl.experiments.arguments import BankArguments
from bgpo_trl.experiments.settings import check_draws
from bgpo_trl.figures.style import COLORS, LINES, save_figure, style_axes
from bgpo_trl.files.writing import write_json


@dataclass(frozen=True)
class UnknownTaskArguments(BankArguments):
    """Demonstrations to leave out."""

    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Seeds of the draws of demonstrations."""
    draws: int = 600
    """Demonstrations that the groups form from."""
    out: Path = Path("runs/unknown-task")
    """Folder of the results."""


def draw(found: dict[str, Detection]) -> Figure:
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
    save_figure(draw(found), arguments.out / "roc.png")
    write_json(arguments.out / "unknown_task.json", results)
    return f"{markdown(table)}\n\nMean area {mean:.3f}."
