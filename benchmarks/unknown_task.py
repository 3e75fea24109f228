"""Detection of a task that was never shown, by its novelty to the groups of behaviors.

    python benchmarks/unknown_task.py
    python benchmarks/unknown_task.py --bank my_bank.safetensors --tasks all

leaves out each task in turn: groups form from demonstrations of the others, and the novelty of
held-out demonstrations says whether their task is known. It prints a table and writes
``unknown_task.json`` and the ROC curves, ``roc.png``.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from bgpo_trl.analysis.novelty import Detection, leave_one_out, roc_curve
from bgpo_trl.experiments.arguments import BankArguments, check_draws, command_line
from bgpo_trl.experiments.run import bank_of
from bgpo_trl.figures.style import COLORS, LINES, save_figure, style_axes


@dataclass(frozen=True)
class Arguments(BankArguments):
    """Measure how well demonstrations of an unknown task are detected."""

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


def main(arguments: Arguments) -> None:
    """Print the table and write the results."""
    check_draws(arguments.seeds, arguments.draws)
    bank = bank_of(arguments)
    if len(bank.tasks) < 2:
        raise ValueError("--tasks: name at least two, of which each is left out in turn")
    found = {
        task: leave_one_out(bank, i, seeds=arguments.seeds, draws=arguments.draws)
        for i, task in enumerate(bank.tasks)
    }
    print("| left out | area under the ROC curve, by seed | detected, % | false alarms, % |")
    print("|---|---|---:|---:|")
    results = {}
    for task, detection in found.items():
        area = detection.area.tolist()
        shares = [100 * float(s.mean()) for s in (detection.detected, detection.false_alarms)]
        results[task] = {"area": area, "detected": shares[0], "false_alarms": shares[1]}
        by_seed = " ".join(f"{value:.3f}" for value in area)
        print(f"| {task} | {by_seed} | {shares[0]:.1f} | {shares[1]:.1f} |")
    mean = np.mean([result["area"] for result in results.values()])
    print(f"\nMean area {mean:.3f}.")
    save_figure(draw(found), arguments.out / "roc.png")
    (arguments.out / "unknown_task.json").write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    command_line(main, __doc__, Arguments)
