"""Tests the claims of the paper on the rows of its unfinished runs.

Protocol 2 of docs/protocol.md: the rows count up to the largest number of episodes that all runs
have reached; a seed's score is the success of its tests in the last fifth of them, its area the
mean over all its tests.

    python benchmarks/studies/paper_claims.py benchmarks/results/paper-quarter
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import tyro
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from bgpo_trl.analysis import statistics
from bgpo_trl.analysis.tables import Table, markdown
from bgpo_trl.evaluation import evaluate_random_policy
from bgpo_trl.experiments.command_line import command_line
from bgpo_trl.figures.style import COLORS, LINES, add_legend, save_figure, style_axes
from bgpo_trl.files.writing import write_whole

N_RANDOM = 300


@dataclass(frozen=True)
class ClaimsArguments:
    """Folders of runs in one folder, each with ``config.json``, ``train.csv`` and ``eval.csv``."""

    runs: Annotated[Path, tyro.conf.Positional]
    """Folder of the runs; ``claims.md`` and ``claims.png`` are written to it."""


def rows_of(folder: Path, name: str) -> pd.DataFrame:
    """Return the rows ``name`` of all runs in a folder, gzipped or not."""
    paths = sorted([*folder.glob(f"*/{name}.csv"), *folder.glob(f"*/{name}.csv.gz")])
    if not paths:
        raise ValueError(f"{folder} has no runs with {name}.csv: name the folder of the runs")
    return pd.concat(map(pd.read_csv, paths), ignore_index=True)


def by_seed(tests: pd.DataFrame, *columns: str) -> pd.Series:
    """Return the success by algorithm, seed and ``columns``, a mean of the means of tasks."""
    keys = ["algorithm", "seed", *columns]
    return tests.groupby([*keys, "task"]).success.mean().groupby(keys).mean()


def conditions(folder: Path) -> tuple[list[str], float]:
    """Return the tasks and the spread of the runs; raise ``ValueError`` if conditions differ."""
    read = [json.loads(path.read_text()) for path in sorted(folder.glob("*/config.json"))]
    wanted = ("tasks", "spread", "task_starts", "schedule", "held_out", "eval_every")
    found = [{name: config[name] for name in wanted} for config in read]
    if any(one != found[0] for one in found):
        raise ValueError(f"the runs in {folder} have different conditions: {wanted}")
    return found[0]["tasks"], found[0]["spread"]


def draw(tests: pd.DataFrame, chance: float, out: Path) -> None:
    """Draw the success of the tests by episodes: mean and one standard deviation of the seeds."""
    figure = Figure((6.3, 3.2), layout="constrained")
    axes = figure.add_subplot()
    style_axes(axes)
    curves = by_seed(tests, "episode")
    for name, color, line in zip(tests.algorithm.unique(), COLORS, LINES, strict=False):
        seeds = curves[name].unstack("episode")
        mean, deviation = seeds.mean(), seeds.std()
        axes.plot(mean.index, mean, color=color, linestyle=line, label=name)
        axes.fill_between(
            mean.index, mean - deviation, mean + deviation, color=color, alpha=0.15, lw=0
        )
    axes.axhline(chance, color="0.35", linestyle=":", linewidth=0.9, label="random actions")
    axes.set(xlabel="training episodes", ylabel="success in tests", ylim=(0, 1))
    axes.yaxis.set_major_formatter(PercentFormatter(1))
    add_legend(figure, *axes.get_legend_handles_labels(), width=6.3)
    save_figure(figure, out)


def paper_claims(arguments: ClaimsArguments) -> str:
    """Test the claims; print and write claims.md, and beside it a figure.

    Raises:
        ValueError: If there are no runs, or their conditions differ.
    """
    folder = arguments.runs
    (tasks, spread), trained = conditions(folder), rows_of(folder, "train")
    tests = rows_of(folder, "eval")
    reached = int(trained.groupby(["algorithm", "seed"]).episode.max().min())
    tests, trained = (rows[rows.episode <= reached] for rows in (tests, trained))
    late = tests[tests.episode > 0.8 * reached]
    chance = evaluate_random_policy(tasks=tasks, episodes=N_RANDOM, seed=0, spread=spread).numpy()
    scores, areas, of_task = by_seed(late), by_seed(tests), late.groupby(["algorithm", "task"])
    steps = late[late.success == 1].groupby("algorithm").steps.mean()
    nodes = trained.groupby(["algorithm", "seed"]).num_nodes.last()
    header = ["algorithm", "score, %", "seeds", "area, %", *tasks, "steps of a success", "nodes"]
    table: Table = [header]
    for name in tests.algorithm.unique():
        of_tasks = [f"{100 * of_task.success.mean()[name, task]:.0f}" for task in tasks]
        grown = [f"{n:.0f}" for n in nodes[name] if np.isfinite(n) and n > 0]
        table.append(
            [
                name,
                statistics.mean(scores[name]).percent(),
                " ".join(f"{100 * score:.0f}" for score in scores[name]),
                statistics.mean(areas[name]).percent(),
                *of_tasks,
                f"{steps[name]:.1f}",
                " ".join(grown) or "-",
            ]
        )
    by_chance = [f"{100 * success:.0f}" for success in chance]
    table.append(["random actions", f"{100 * chance.mean():.1f}", "", "", *by_chance, "", ""])
    contrasts: Table = [["first", "second", "score, points", "verdict", "area, points", "verdict"]]
    for first, second in combinations(tests.algorithm.unique(), 2):
        row = [first, second]
        for values in (scores, areas):
            found = statistics.difference(values[first], values[second])
            row += [found.estimate.points(), found.verdict]
        contrasts.append(row)
    n_late = len(late) // len(scores)
    text = f"""Rows of the first {reached:,} episodes, spread {spread:g}.
Score: the last fifth, {n_late} tests of a seed. Intervals of 95 % (Student, Welch).
Tasks in percent. Nodes of GWR-B at the end.

{markdown(table)}

{markdown(contrasts)}
"""
    write_whole(folder / "claims.md", text)
    draw(tests, float(chance.mean()), folder / "claims.png")
    return text


if __name__ == "__main__":
    command_line(paper_claims)
