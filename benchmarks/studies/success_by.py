"""Success of one algorithm by a number of config.json in which alone its runs differ.

python benchmarks/studies/success_by.py runs/spread --by spread
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from matplotlib.figure import Figure
from numpy.typing import ArrayLike
from shared import style_success

from bgpo_trl.analysis import statistics
from bgpo_trl.analysis.comparison import check_conditions, joined, title_of
from bgpo_trl.analysis.scores import late_scores
from bgpo_trl.analysis.tables import Section, Table
from bgpo_trl.experiments.command_line import command_line
from bgpo_trl.experiments.report import write_sections
from bgpo_trl.figures.style import COLORS, LINES, MARKERS, readable
from bgpo_trl.runs.results import Run, read_run, run_directories


@dataclass(frozen=True)
class ByArguments:
    """Finished runs of one algorithm."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of runs, or run directories."""
    by: str = "spread"
    """Setting in which the runs differ, a number."""
    out: Path | None = None
    """Folder to write to; by default that of the runs."""


def runs_by(directories: Sequence[Path], name: str) -> dict[float, Run]:
    """Return the runs of an algorithm by the number in which alone they differ, in its order.

    Raises:
        ValueError: If a run is damaged or not finished, has another algorithm or other conditions
            than the first, or if its setting is not a number, or that of another run.
    """
    runs = joined(map(read_run, directories))
    first, found = runs[0], dict[float, Run]()
    for run in runs:
        value = run.config.get(name)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ValueError(f"--by {name}: it is {value!r} in {run.directory}, and no number")
        if run.unfinished:
            raise ValueError(f"{run.directory} {run.unfinished}: let the run finish")
        if title_of(run) != title_of(first):
            names = f"{title_of(first)}, {title_of(run)}"
            raise ValueError(f"--by takes runs of one algorithm: {names}")
        check_conditions(first, run, (name,))
        if value in found:
            raise ValueError(f"--by {name}: {found[value].directory}, {run.directory} have {value}")
        found[value] = run
    return dict(sorted(found.items()))


def section_by(runs: dict[float, Run], name: str) -> Section:
    """Return the section of success by a number, with its figure."""
    first = next(iter(runs.values()))
    scores = {value: late_scores(run) for value, run in runs.items()}
    table: Table = [[name, "seeds", "success", *first.tasks, "random actions"]]
    for value, run in runs.items():
        success, random = scores[value], run.summary.get("random_success") or {}
        cells = [statistics.mean(column).percent() for column in (success.mean(1), *success.T)]
        by_chance = " ".join(f"{100 * random[task]:.0f}" for task in first.tasks if task in random)
        table.append([f"{value:g}", str(len(success)), *cells, by_chance or "-"])
    figure = plot_by(scores, first.tasks, label=name.replace("_", " ").capitalize())
    commands = {value: run.summary.get("command") for value, run in runs.items()}
    notes = [
        f"{first.last:,} episodes each; success in percent, in tests over the last 10 % of "
        "training, means over seeds with 95 % intervals (Student's t).",
        *(f"{value:g}: `{command}`" for value, command in commands.items() if command),
    ]
    figures = {f"means over seeds, and each seed, by {name}": (f"by-{name}.png", figure)}
    return Section(f"Success by {name}: {title_of(first)}", table, figures, notes)


def plot_by(success: Mapping[float, ArrayLike], tasks: Sequence[str], *, label: str) -> Figure:
    """Plot the success on each task against a number, as lines.

    Lines are means over seeds; dots are single seeds.

    Args:
        success: Success in [0, 1] of each seed and task, ``[S, T]``, by the number.
        tasks: Names of the tasks.
        label: Name of the number.
    """
    found = {number: np.asarray(scores, float) for number, scores in sorted(success.items())}
    figure = Figure(figsize=(4.2, 3.2), layout="constrained")
    axes = figure.add_subplot()
    for index, task in enumerate(tasks):
        style: dict[str, Any] = {
            "color": COLORS[index % len(COLORS)],
            "marker": MARKERS[index % len(MARKERS)],
        }
        means = [scores[:, index].mean() for scores in found.values()]
        line = LINES[index % len(LINES)]
        axes.plot([*found], means, label=readable(task), linestyle=line, markersize=5, **style)
        for number, scores in found.items():
            numbers = np.full(len(scores), number)
            axes.scatter(numbers, scores[:, index], s=8, alpha=0.5, clip_on=False, **style)
    axes.set_xticks([*found])
    axes.set_xlabel(label, fontsize=9)
    style_success(figure, axes)
    return figure


def success_by(arguments: ByArguments) -> str:
    """Write the success by a setting in which alone the runs of one algorithm differ.

    Prints and writes tables.md, and beside it a figure.

    Raises:
        ValueError: If a run is damaged or not finished, or runs differ in anything else.
    """
    if not (arguments.out and arguments.runs) and len(arguments.runs) != 1:
        raise ValueError("name a folder of runs, or several and --out")
    runs = runs_by(run_directories(arguments.runs), arguments.by)
    return write_sections([section_by(runs, arguments.by)], arguments.out or arguments.runs[0])


if __name__ == "__main__":
    command_line(success_by)
