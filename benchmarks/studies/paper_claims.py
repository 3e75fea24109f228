"""The claims of the paper are tested on the rows of its unfinished runs.

Protocols 2 to 7 of docs/protocol.md: the rows count up to the largest number of episodes that all
runs have reached; a seed's score is the success of its tests in the last fifth of them, its area
the mean over all its evaluations of the success of the tasks presented by then. Runs of one arm are
in folders of one name, with the seeds after it.

    python benchmarks/studies/paper_claims.py benchmarks/results/paper-quarter
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from bgpo_trl.analysis import statistics
from bgpo_trl.analysis.comparison import check_conditions, joined
from bgpo_trl.analysis.tables import Table, markdown
from bgpo_trl.evaluation import evaluate_random_policy
from bgpo_trl.experiments.command_line import command_line
from bgpo_trl.figures.style import save_figure
from bgpo_trl.figures.success import plot_success_curves
from bgpo_trl.files.writing import write_whole
from bgpo_trl.runs.results import Run, read_run, run_directories

N_RANDOM = 300


@dataclass(frozen=True)
class ClaimsArguments:
    """Runs of equal conditions in one folder, of as many arms and seeds as there are."""

    runs: Annotated[Path, tyro.conf.Positional]
    """Folder of the runs; ``claims.md`` and ``claims.png`` are written to it."""


def runs_of(folder: Path) -> tuple[dict[str, Run], int]:
    """Return the runs by arm, up to the episode that all have reached, and this episode.

    Raises:
        ValueError: If there is no run, one is damaged or without training episodes, conditions
            differ, or runs of an arm cannot be joined.
    """
    read = [read_run(directory) for directory in run_directories([folder])]
    for run in read:
        check_conditions(read[0], run, ["episodes"])
        if run.training is None or run.training.empty:
            raise ValueError(f"{run.directory} has no training episodes: let the run begin")
    played = [run.training for run in read if run.training is not None]
    reached = min(int(rows.groupby("seed").episode.max().min()) for rows in played)
    cut = [
        replace(run, tests=run.tests[run.tests.episode <= reached], training=rows)
        for run, rows in zip(read, (r[r.episode <= reached] for r in played), strict=True)
    ]
    runs = {re.sub(r"(-\d+)+$", "", run.directories[0].name): run for run in joined(cut)}
    if sum(len(run.directories) for run in runs.values()) < len(cut):
        raise ValueError(f"{folder} has runs of an arm with other settings: keep one setting")
    return runs, reached


def paper_claims(arguments: ClaimsArguments) -> str:
    """Test the claims; print and write claims.md, and beside it a figure.

    Raises:
        ValueError: See `runs_of`.
    """
    folder = arguments.runs
    runs, reached = runs_of(folder)
    first = next(iter(runs.values()))
    spread = first.config["spread"]
    chance = evaluate_random_policy(tasks=first.tasks, episodes=N_RANDOM, seed=0, spread=spread)
    scores, areas, n_tests = {}, {}, 0
    table: Table = [
        ["arm", "score, %", "seeds", "area, %", *first.tasks, "steps of a success", "nodes"]
    ]
    for name, run in runs.items():
        late = run.tests[run.tests.episode > 0.8 * reached]
        success = run.success[:, run.episodes > 0.8 * reached]
        # Of each evaluation, the mean over the tasks presented so far.
        scores[name], areas[name] = success.mean((1, 2)), np.nanmean(run.success, 2).mean(1)
        n_tests = len(late) // len(run.seeds)
        assert run.training is not None
        nodes = run.training.groupby("seed").num_nodes.last()
        table.append(
            [
                name,
                statistics.mean(scores[name]).percent(),
                " ".join(f"{100 * score:.0f}" for score in scores[name]),
                statistics.mean(areas[name]).percent(),
                *(f"{100 * of_task:.0f}" for of_task in success.mean((0, 1))),
                f"{late[late.success == 1].steps.mean():.1f}",
                " ".join(f"{n:.0f}" for n in nodes if n > 0) or "-",
            ]
        )
    by_chance = [f"{100 * success:.0f}" for success in chance.tolist()]
    table.append(["random actions", f"{100 * chance.mean():.1f}", "", "", *by_chance, "", ""])
    contrasts: Table = [["first", "second", "score, points", "verdict", "area, points", "verdict"]]
    for one, other in combinations(runs, 2):
        row = [one, other]
        for values in (scores, areas):
            found = statistics.difference(values[one], values[other])
            row += [found.estimate.points(), found.verdict]
        contrasts.append(row)
    text = f"""Rows of the first {reached:,} episodes, spread {spread:g}.
Score: the last fifth, {n_tests} tests of a seed. Intervals of 95 % (Student, Welch).
Tasks in percent. Nodes of GWR-B at the end.

{markdown(table)}

{markdown(contrasts)}
"""
    write_whole(folder / "claims.md", text)
    by_task = dict(zip(first.tasks, chance.tolist(), strict=True))
    arm = next(iter(runs))
    runs[arm] = replace(first, summary={**first.summary, "random_success": by_task})
    save_figure(plot_success_curves(runs, window=first.eval_every), folder / "claims.png", dpi=150)
    return text


if __name__ == "__main__":
    command_line(paper_claims)
