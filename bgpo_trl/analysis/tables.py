"""Tables of the report: success, forgetting and transfer, learning times, groups of GWR-B."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from bgpo_trl.analysis import metrics
from bgpo_trl.analysis.comparison import (
    Run,
    Statistics,
    Values,
    area_scores,
    late_scores,
    starts,
    task_area,
)
from bgpo_trl.runs.results import read_outcomes, read_rows
from suites import nico

Table = list[list[str]]
"""Rows of cells; the first row holds the column names."""


def main_table(runs: Mapping[str, Run], statistics: Statistics) -> Table:
    """Return the table of success of a group's runs."""
    rows = [["", "last 10 %: IQM", "mean", *(f"task {i + 1}" for i in range(3)), "area: IQM"]]
    rows[0].append("episodes to 80 %")
    for run in runs.values():
        late = late_scores(run)
        reached = metrics.overall_episodes_to(run.curves.success, run.curves.episodes)
        rows.append(
            [
                run.name,
                statistics.cell(late),
                f"{100 * late.mean():.1f}",
                *(f"{100 * share:.0f}" for share in late.mean(0)),
                statistics.cell(area_scores(run)),
                f"{reached:.0f}" if np.isfinite(reached) else "not reached",
            ]
        )
    return rows


def continual_table(continual: Mapping[str, Run], concurrent: Mapping[str, Run]) -> Table:
    """Return the table of forgetting and transfer of the continual runs."""
    rows = [["", "forgotten since learned", "forgotten since best", "backward", "forward"]]
    for key, run in continual.items():
        success, episodes = run.curves.success, run.curves.episodes
        ends = [*starts(run)[1:], int(episodes[-1])]
        matrix = metrics.evaluation_matrix(
            success, episodes, ends, window=max(1, round(0.1 * episodes[-1]))
        )
        best = metrics.forgetting_since_best(metrics.trailing_mean(success, 3))
        cells = [
            _spread(metrics.forgetting_since_learned(matrix)),
            _spread(best),
            _spread(metrics.backward_transfer(matrix)),
        ]
        beside = concurrent.get(key.replace("continual", "concurrent"))
        rows.append([run.name, *cells, "" if beside is None else _forward(run, beside)])
    return rows


def _forward(run: Run, beside: Run) -> str:
    gains = []
    for task, start in enumerate(starts(run)):
        if start == 0:
            continue
        length = int(min(run.curves.episodes[-1] - start, beside.curves.episodes[-1]))
        reference = task_area(beside, task, 0, length).mean()
        gains.append(metrics.forward_transfer(task_area(run, task, start, length), reference))
    return _spread(np.mean(gains, axis=0))


def _spread(values: Values) -> str:
    return f"{100 * values.mean():.1f} ± {100 * values.std():.1f}"


def own_episodes(path: Path, tasks: Sequence[str], last: int | None = None) -> Values | None:
    """Return the training episodes of each task until 50 % of them succeed, ``[S, T]``.

    Args:
        path: A run's ``train.csv``.
        tasks: Task names.
        last: Last training episode to count; ``None`` for the end of the run.

    Returns:
        Infinite where 50 % was not reached; ``None`` if the file is missing or has no episodes.
    """
    outcomes = read_outcomes(path, tasks, last) if path.exists() else []
    if not outcomes:
        return None
    return np.array([[metrics.trials_to(task) for task in seed] for seed in outcomes])


def speed_table(runs: Mapping[str, Run]) -> Table:
    """Return the table of learning times: each task's training episodes to 50 % success."""
    tasks = [f"task {i + 1}" for i in range(3)]
    rows = [["", *tasks, *(f"{task} : {tasks[0]}" for task in tasks[1:])]]
    for run in runs.values():
        last = int(run.curves.episodes[-1])
        episodes = own_episodes(run.directory / "train.csv", nico.PAPER_TASKS, last)
        if episodes is None:
            rows.append([run.name, *["no train.csv"] * len(tasks), *[""] * (len(tasks) - 1)])
        else:
            rows.append([run.name, *map(median_cell, episodes.T), *ratio_cells(episodes)])
    return rows


def median_cell(episodes: Values) -> str:
    """Format the median over seeds, with the number of seeds that never reached 50 %.

    Args:
        episodes: Learning time of each seed, infinite where never reached, ``[S]``.
    """
    never = int(np.isinf(episodes).sum())
    median = float(np.median(episodes))
    cell = f"{median:.0f}" if np.isfinite(median) else "not reached"
    return f"{cell} ({never} of {len(episodes)} seeds never)" if never else cell


def ratio_cells(episodes: Values) -> list[str]:
    """Format the later tasks' learning times as multiples of the first's, with the number of seeds.

    Args:
        episodes: Learning times, infinite where 50 % was never reached, ``[S, T]``.
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
