"""Tables of the report: success, forgetting and transfer, learning times, groups of GWR-B."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from bgpo_trl.analysis import metrics
from bgpo_trl.analysis.comparison import (
    Run,
    Values,
    area_scores,
    late_scores,
    starts,
    success_at,
)
from bgpo_trl.analysis.intervals import Statistics, means, percent_cell
from bgpo_trl.analysis.transfer import forward_transfer
from bgpo_trl.runs.results import read_outcomes, read_rows

Table = list[list[str]]
"""Rows of cells; the first row holds the column names."""


def main_table(runs: Mapping[str, Run], statistics: Statistics) -> Table:
    """Return the table of success of a group's runs."""
    tasks = _numbered(runs)
    rows = [["", "last 10 %: IQM", "mean", *tasks, "area: IQM"]]
    rows[0].append("episodes to 80 %")
    for run in runs.values():
        late = late_scores(run)
        reached = "-"  # Among tasks one after the other, the first would be counted alone.
        if not any(starts(run)):
            episodes = metrics.overall_episodes_to(run.curves.success, run.curves.episodes)
            reached = f"{episodes:.0f}" if np.isfinite(episodes) else "not reached"
        rows.append(
            [
                run.name,
                statistics.cell(late),
                f"{100 * late.mean():.1f}",
                *(f"{100 * share:.0f}" for share in late.mean(0)),
                statistics.cell(area_scores(run)),
                reached,
            ]
        )
    return rows


def _numbered(runs: Mapping[str, Run]) -> list[str]:
    """Return the column names of the tasks, which all runs have in common."""
    return [f"task {number}" for number, _ in enumerate(next(iter(runs.values())).tasks, 1)]


def continual_table(
    continual: Mapping[str, Run], concurrent: Mapping[str, Run], statistics: Statistics
) -> Table:
    """Return the table of forgetting and transfer of the continual runs."""
    rows = [["", "backward transfer", "forgotten since best", "forward transfer"]]
    for key, run in continual.items():
        matrix = success_at(run, [*starts(run)[1:], int(run.curves.episodes[-1])])
        best = metrics.forgetting_since_best(metrics.trailing_mean(run.curves.success, 3))
        measured = (metrics.backward_transfer(matrix), best[:, None])
        cells = [statistics.cell(scores, means) for scores in measured]
        beside = concurrent.get(f"concurrent-{key.removeprefix('continual-')}")
        forward = ""
        if beside is not None:
            forward = percent_cell(*forward_transfer(run, beside, statistics))
        rows.append([run.name, *cells, forward])
    return rows


def own_episodes(path: Path, tasks: Sequence[str], last: int | None = None) -> Values | None:
    """Return the training episodes of each task until 50 % of them succeed, ``[S, T]``.

    Infinite where 50 % was not reached by episode ``last`` (the end of the run if ``None``);
    ``None`` if ``path``, a ``train.csv``, is missing or has no episodes.
    """
    outcomes = read_outcomes(path, tasks, last) if path.exists() else []
    if not outcomes:
        return None
    return np.array([[metrics.trials_to(task) for task in seed] for seed in outcomes])


def speed_table(runs: Mapping[str, Run]) -> Table:
    """Return the table of learning times: each task's training episodes to 50 % success."""
    tasks = _numbered(runs)
    rows = [["", *tasks, *(f"{task} : {tasks[0]}" for task in tasks[1:])]]
    for run in runs.values():
        last = int(run.curves.episodes[-1])
        episodes = own_episodes(run.directory / "train.csv", run.tasks, last)
        if episodes is None:
            rows.append([run.name, *["no train.csv"] * len(tasks), *[""] * (len(tasks) - 1)])
        else:
            rows.append([run.name, *map(median_cell, episodes.T), *ratio_cells(episodes)])
    return rows


def median_cell(episodes: Values) -> str:
    """Format the median of learning times ``[S]``, and the number of infinite ones."""
    never = int(np.isinf(episodes).sum())
    median = float(np.median(episodes))
    cell = f"{median:.0f}" if np.isfinite(median) else "not reached"
    return f"{cell} ({never} of {len(episodes)} seeds never)" if never else cell


def ratio_cells(episodes: Values) -> list[str]:
    """Format learning times ``[S, T]`` as multiples of the first task's.

    Cells give the number of seeds if some never learned the first task.
    """
    learned = int(np.isfinite(episodes[:, 0]).sum())
    note = "" if learned == len(episodes) else f" ({learned} of {len(episodes)} seeds)"
    return [
        "" if np.isnan(times) else ("not reached" if np.isinf(times) else f"{times:.2f}") + note
        for times in metrics.times_the_first(episodes).tolist()
    ]


def groups_table(runs: Iterable[Run]) -> Table:
    """Return the table of groups, purity and task inference; empty if no run has finished."""
    rows = [["", "groups", "purity, %", "tasks inferred, %", "by seed", "nodes of GWR-B"]]
    for run in runs:
        if run.summary.get("nodes") is None:
            continue
        groups, purity = run.summary.get("groups"), run.summary.get("group_purity")
        inferred = _inferred(run)
        rows.append(
            [
                run.directory.name,
                "one for all" if groups is None else _numbers(groups),
                "" if purity is None else _numbers([100 * share for share in purity], 1),
                f"{100 * np.mean(inferred):.2f}" if inferred else "",
                _numbers([100 * share for share in inferred], 1),
                _numbers(run.summary["nodes"]),
            ]
        )
    return rows if len(rows) > 1 else []


def _inferred(run: Run) -> list[float]:
    """Return the share of held-out demonstrations whose task is inferred, by seed."""
    path = run.directory / "final.csv"
    shares: dict[int, list[float]] = {seed: [] for seed in run.config["seeds"]}
    for row in read_rows(path) if path.exists() else []:
        if row["demonstrations"] == "held-out" and row["task_inference"]:
            shares[int(row["seed"])].append(float(row["task_inference"]))
    return [float(np.mean(of_seed)) for of_seed in shares.values() if of_seed]


def _numbers(values: Iterable[float], digits: int = 0) -> str:
    """Join numbers with spaces, dropping a decimal of 0."""
    return " ".join(f"{value:.{digits}f}".removesuffix(".0") for value in values)
