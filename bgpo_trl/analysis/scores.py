"""Scores of a run: arrays by seed and task, from which tables and comparisons are made."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from bgpo_trl.analysis import metrics
from bgpo_trl.analysis.comparison import Run
from bgpo_trl.runs.results import find_table, read_final_tests, read_outcomes, read_tests

Values = NDArray[np.float64]


def late_window(run: Run) -> int:
    """Return the length of the last 10 % of training in episodes, at least one test."""
    return max(run.eval_every, round(0.1 * run.last))


def late_scores(run: Run) -> Values:
    """Return the mean success over the last 10 % of training, ``[S, T]``.

    Raises:
        ValueError: If a seed has no test of a task then.
    """
    curves = run.curves
    scores = metrics.evaluation_matrix(
        curves.success, curves.episodes, [run.last], window=late_window(run)
    )[:, 0]
    # A seed may also be missing altogether.
    lacking = [seed for seed in run.config["seeds"] if seed not in curves.seeds]
    lacking += [curves.seeds[index] for index in np.flatnonzero(np.isnan(scores).any(1))]
    if lacking:
        raise ValueError(
            f"{run.directory} has no late test of seed {lacking[0]}, or not of each task: let the "
            "run finish"
        )
    return scores


def area_scores(run: Run) -> Values:
    """Return the area under each task's curve since its presentation, ``[S, T]``."""
    episodes, areas = run.curves.episodes, []
    for task, start in enumerate(run.starts):
        since = episodes > start
        curve = run.curves.success[:, since, task]
        areas.append(metrics.area_under_curve(curve, episodes[since] - start))
    return np.stack(areas, axis=-1)


def best_scores(run: Run) -> Values:
    """Return each task's highest mean success over seeds in any 10 % of training, ``[T]``."""
    curves, window = run.curves, late_window(run)
    best = np.full(len(run.tasks), -np.inf)
    for task in range(len(run.tasks)):
        tested = ~np.isnan(curves.success[..., task]).all(0)
        episodes, success = curves.episodes[tested], curves.success[:, tested, task]
        whole = episodes[episodes >= episodes[0] + window - 1]
        for end in whole if len(whole) else episodes[-1:]:
            inside = (episodes > end - window) & (episodes <= end)
            best[task] = max(best[task], np.nanmean(success[:, inside]))
    return best


def success_matrix(run: Run) -> Values:
    """Return ``R[i, j]``, the success on task j at the end of phase i, ``[S, T, T]``.

    Success is the mean over the last fifth of a phase, at least one evaluation; NaN for tasks that
    have not been presented.

    Raises:
        ValueError: If tasks do not start one after the other, or a phase has no test of its task.
    """
    begun = run.starts
    lengths = [end - start for start, end in pairwise([*begun, run.last])]
    if min(lengths) <= 0:
        raise ValueError(
            f"{run.directory} starts its tasks at {begun}: only for tasks one after the other"
        )
    window = max(run.eval_every, min(lengths) // 5)
    matrix = metrics.evaluation_matrix(
        run.curves.success, run.curves.episodes, [*begun[1:], run.last], window=window
    )
    if np.isnan(np.diagonal(matrix, axis1=-2, axis2=-1)).any():
        raise ValueError(
            f"{run.directory} has a phase of {min(lengths)} episodes without a test of its task: "
            "let it be tested more often than once a phase"
        )
    return matrix


def episodes_to_80(run: Run) -> float:
    """Return the training episodes until overall success reaches 80 %, infinity if never."""
    return metrics.overall_episodes_to(run.curves.success, run.curves.episodes)


def own_episodes(run: Run, threshold: float = 0.5) -> Values | None:
    """Return the training episodes of each task until a rate of them succeed, ``[S, T]``.

    See `metrics.trials_to`; infinite where that was not reached. None if the run has no
    ``train.csv``.
    """
    path = run.directory / "train.csv"
    outcomes = read_outcomes(path, run.tasks, run.last) if find_table(path) else []
    if not outcomes:
        return None
    return np.array([[metrics.trials_to(task, threshold) for task in seed] for seed in outcomes])


def success_lengths(run: Run) -> dict[str, float]:
    """Return the mean length in steps of each task's successful tests in the last 10 % of training.

    Tasks without a success, or without lengths, are left out.
    """
    tests = read_tests(run.directory / "eval.csv")
    if "steps" not in tests:
        return {}
    late = tests["episode"].between(run.last - late_window(run), run.last, inclusive="right")
    won = tests[late & (tests["success"] == 1)]
    steps = pd.to_numeric(won["steps"], errors="coerce").groupby(won["task"]).mean()
    return {str(task): float(length) for task, length in steps.dropna().items()}


def final_shares(run: Run, kind: str, column: str) -> Values | None:
    """Return a column of the final tests, ``[S, T]``; None without tests or without its values.

    Args:
        run: The run.
        kind: ``seen`` or ``held-out``, the demonstrations of the tests.
        column: ``success`` or ``task_inference``.

    Raises:
        ValueError: If the file is damaged, or lacks tests of a seed and task.
    """
    path = run.directory / "final.csv"
    if not find_table(path):
        return None
    tests = read_final_tests(path)
    tests = tests[tests["demonstrations"] == kind]
    every = pd.MultiIndex.from_product([run.curves.seeds, run.tasks], names=["seed", "task"])
    found = tests.groupby(["seed", "task"])
    if not every.isin(found.size().index).all():
        raise ValueError(
            f"{path} lacks tests with {kind} demonstrations: remove it and resume the run"
        )
    shares = found[column].mean().reindex(every).to_numpy(float)
    shape = len(run.curves.seeds), len(run.tasks)
    return None if np.isnan(shares).any() else shares.reshape(shape)
