"""Differences between two runs, task by task and over parts of training.

    python benchmarks/compare.py runs/before runs/after

prints, for each task and their mean, the test success of both runs over the last 10 % of training,
the second's lead with its 95 % interval (Welch), the p value of a permutation test of seeds, and
what is found; with ``--every 500``, also over each part of training of so many episodes. If one run
is shorter, only the part that both have is compared. ``report.py`` compares more runs at once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro

from bgpo_trl.analysis import metrics, statistics
from bgpo_trl.analysis.comparison import differing_conditions, read_run
from bgpo_trl.analysis.scores import Values, late_scores
from bgpo_trl.analysis.tables import Table, markdown
from bgpo_trl.experiments.arguments import command_line


@dataclass(frozen=True)
class Arguments:
    """Compare two runs."""

    first: tyro.conf.Positional[Path]
    """Directory of the first run."""
    second: tyro.conf.Positional[Path]
    """Directory of the second run."""
    every: int | None = None
    """Training episodes in a part of training."""
    anyway: bool = False
    """Compare also runs under different conditions, such as other encoders or tests."""


def rows_of(period: str, tasks: tuple[str, ...], first: Values, second: Values) -> Table:
    """Return a row for each task and their mean, from scores ``[S, T]``.

    Tasks that were not tested are left out.
    """
    tested = [index for index in range(len(tasks)) if not np.isnan(first[:, index]).any()]
    tested = [index for index in tested if not np.isnan(second[:, index]).any()]
    rows = []
    for what, chosen in [*((tasks[index], [index]) for index in tested), ("all", tested)]:
        if not chosen:
            continue
        ours, theirs = first[:, chosen].mean(1), second[:, chosen].mean(1)
        found = statistics.difference(theirs, ours)
        p = "-" if np.isnan(found.p) else f"{found.p:.3f}"
        cells = [f"{100 * scores.mean():.1f}" for scores in (ours, theirs)]
        rows.append([period, what, *cells, found.estimate.points(), p, found.note])
    return rows


def main(arguments: Arguments) -> None:
    """Print the table."""
    every = arguments.every
    if every is not None and every < 1:
        raise ValueError(f"--every must be at least 1 episode, got {every}")
    first, second = map(read_run, (arguments.first, arguments.second))
    differing = differing_conditions(first, second, ("episodes",))
    if first.tasks != second.tasks:
        raise ValueError(f"{differing}: only runs of the same tasks in the same order are compared")
    if differing and not arguments.anyway:
        raise ValueError(f"{differing}: only runs under equal conditions are compared; --anyway")
    last = min(first.last, second.last)
    runs = [replace(run, curves=run.curves.until(last)) for run in (first, second)]
    rows: Table = [["episodes", "task", "first", "second", "second - first", "p", "found"]]
    for end in range(every, last + 1, every) if every else ():
        matrices = [
            metrics.evaluation_matrix(run.curves.success, run.curves.episodes, [end], window=every)
            for run in runs
        ]
        rows += rows_of(f"to {end}", first.tasks, *(matrix[:, 0] for matrix in matrices))
    rows += rows_of("last 10 %", first.tasks, *map(late_scores, runs))
    print(*([differing] if differing else []), markdown(rows), sep="\n\n")


if __name__ == "__main__":
    command_line(main, __doc__, Arguments)
