"""Scores of a run: arrays by seed and task, from which tables and comparisons are made.

Among them is the forward transfer between tasks that are presented one after the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from bgpo_trl.analysis import metrics
from bgpo_trl.analysis.comparison import Run
from bgpo_trl.analysis.statistics import Estimate, contrast
from bgpo_trl.runs.results import TRAIN, find_table, read_final_tests, read_table, read_tests

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
            inside = metrics.in_window(episodes, end, window)
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
    if not find_table(path):
        return None
    table = read_table(path, TRAIN).sort_values(["seed", "episode"])
    table = table[table["episode"] <= run.last]
    if table.empty:
        return None
    times = table.groupby(["seed", "task"])["success"].agg(metrics.trials_to, threshold)
    return times.unstack("task").reindex(columns=list(run.tasks)).fillna(np.inf).to_numpy()


def success_lengths(run: Run) -> dict[str, float]:
    """Return the mean length in steps of each task's successful tests in the last 10 % of training.

    Tasks without a success, or without lengths, are left out.
    """
    tests = read_tests(run.directory / "eval.csv")
    if "steps" not in tests:
        return {}
    late = metrics.in_window(tests["episode"], run.last, late_window(run))
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


def expected_own_episodes(
    begun: Sequence[int], task: int, episodes: ArrayLike, *, practised: bool = True
) -> Values:
    """Return the expected number of a task's own training episodes after ``episodes`` ``[E]``.

    An episode is of each task presented so far with equal probability; if earlier tasks are not
    ``practised``, of each of the newest. ``begun`` are the episodes from which tasks are presented.
    """
    later = sorted({start for start in begun if start >= begun[task]})
    played = np.zeros(np.shape(episodes))
    for start, end in pairwise([*later, np.inf]):
        newest = max(other for other in begun if other <= start)
        drawn = [other <= start if practised else other == newest for other in begun]
        if drawn[task]:
            played += (np.clip(episodes, start, end) - start) / sum(drawn)
    return played


def forward_transfer(run: Run, reference: Run) -> Estimate | None:
    """Return the mean forward transfer to all tasks but the first, with its 95 % interval.

    Computed as in Continual World (`metrics.forward_transfer`), from the areas of `own_areas`,
    means over seeds. The interval is Welch's of the seeds' contributions to first order (the delta
    method), so that the seeds of the reference count, too. None if the reference leaves nothing to
    gain on a task.
    """
    ours, theirs = own_areas(run, reference)
    area, height = ours.mean(0), theirs.mean(0)
    left = 1 - height
    if (left == 0).any():
        return None
    gained = contrast(
        [(ours / left).mean(-1), (theirs * (1 - area) / left**2).mean(-1)], [1.0, -1.0]
    )
    value = float(metrics.forward_transfer(area, height).mean())
    return replace(gained, value=value).interval()


def own_areas(run: Run, reference: Run) -> tuple[Values, Values]:
    """Return the areas under each task's curves of a run and a reference, ``[S, T - 1]`` each.

    The mean height of a task's curve from the first to the last test of its own phase. As an
    episode is of any of the presented tasks, curves are over the expected number of the task's own
    episodes, and the reference's is read off at the tests of the run: learners with the same curve
    have the same area. The first task is left out, since nothing precedes it. Tasks of the
    reference may have another order.
    """
    begun, areas = run.starts, []
    for task, end in enumerate([*begun[2:], run.last], 1):
        own, curves = _own_curves(run, task)
        of_reference, others = _own_curves(reference, reference.tasks.index(run.tasks[task]))
        last = min(float(_own_episodes(run, task, end)), of_reference[-1])
        first = min(max(own[0], of_reference[0]), last)
        tests = np.array([first, *own[(own > first) & (own < last)], last])
        areas.append((_mean_height(tests, own, curves), _mean_height(tests, of_reference, others)))
    ours, theirs = zip(*areas, strict=True)
    return np.stack(ours, axis=-1), np.stack(theirs, axis=-1)


def _own_curves(run: Run, task: int) -> tuple[Values, Values]:
    """Return a task's expected own episodes at its tests, ``[E]``, and the curves, ``[S, E]``."""
    own = _own_episodes(run, task, run.curves.episodes)
    played = np.diff(own, prepend=0.0) > 0
    return own[played], run.curves.success[:, played, task]


def _own_episodes(run: Run, task: int, episodes: ArrayLike) -> Values:
    practised = run.config.get("schedule", "practised") == "practised"
    return expected_own_episodes(run.starts, task, episodes, practised=practised)


def _mean_height(tests: Values, episodes: Values, curves: Values) -> Values:
    """Return the mean height of curves between the first and the last of some episodes, ``[S]``."""
    heights = np.stack([np.interp(tests, episodes, curve) for curve in curves])
    if tests[0] == tests[-1]:  # a single test
        return heights[:, -1]
    return np.trapezoid(heights, tests, axis=-1) / (tests[-1] - tests[0])
