"""Measures of multi-task and continual learning, of the ``S`` seeds and ``T`` tasks of a run.

``success`` ``[..., E, T]`` is the share of successes on each task at each of ``E`` evaluations. NaN
marks tasks that were not tested, because they had not been presented yet. ``episodes`` ``[E]`` are
the training episodes before each evaluation.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bgpo_trl.analysis.statistics import Estimate, contrast
from bgpo_trl.runs.results import Run

Values = NDArray[np.float64]


def known_mean(values: Values, axis: int = 0) -> Values:
    """Return the mean of the values that are not NaN along an axis, by default seeds.

    NaN where all are.
    """
    return np.ma.filled(np.ma.masked_invalid(values).mean(axis), np.nan)


def late_window(run: Run) -> int:
    """Return the length of the last 10 % of training in episodes, at least one test."""
    return max(run.eval_every, round(0.1 * run.last))


def evaluation_matrix(run: Run, ends: Sequence[int], window: int) -> Values:
    """Return ``R[i, j]``, the success on task j at the end of phase i, ``[S, P, T]``.

    ``ends`` ``[P]`` are the last episodes of the phases. Success is the mean over the evaluations
    in the ``window`` episodes before an end; NaN for tasks without a test among them.

    Raises:
        ValueError: If a phase has no evaluation in its window.
    """
    phases = []
    for end in ends:
        chosen = (run.episodes > end - window) & (run.episodes <= end)
        if not chosen.any():
            raise ValueError(
                f"there is no evaluation in the {window} episodes before episode {end}: test "
                "more often, or for a longer run"
            )
        phases.append(known_mean(run.success[:, chosen], axis=1))
    return np.stack(phases, axis=1)


def late_scores(run: Run) -> Values:
    """Return the mean success over the last 10 % of training, ``[S, T]``.

    Raises:
        ValueError: If a seed has no test of a task then.
    """
    scores = evaluation_matrix(run, [run.last], late_window(run))[:, 0]
    lacking = np.flatnonzero(np.isnan(scores).any(1))
    if len(lacking):
        raise ValueError(
            f"{run.directory} has no late test of seed {run.seeds[lacking[0]]}, or not of each "
            "task: let the run finish, or test more often"
        )
    return scores


def area_under_curve(success: ArrayLike, episodes: ArrayLike) -> Values:
    """Return the mean height of learning curves ``[..., E]``, between 0 and 1, ``[...]``.

    Integrates by trapezoids; before the first evaluation, the curve rises linearly from 0 at
    episode 0. Curves must not contain NaN.
    """
    success, episodes = np.asarray(success, float), np.asarray(episodes, float)
    heights = np.concatenate([np.zeros((*success.shape[:-1], 1)), success], axis=-1)
    return np.trapezoid(heights, np.concatenate([[0.0], episodes]), axis=-1) / episodes[-1]


def area_scores(run: Run) -> Values:
    """Return the area under each task's curve since its presentation, ``[S, T]``.

    Raises:
        ValueError: If a seed has no test of a task in an evaluation since then.
    """
    areas = []
    for task, start in enumerate(run.starts):
        since = run.episodes > start
        curve = run.success[:, since, task]
        lacking = np.argwhere(np.isnan(curve))
        if len(lacking):
            seed, test = lacking[0]
            raise ValueError(
                f"{run.directory} has no test of seed {run.seeds[seed]} in {run.tasks[task]} after "
                f"{run.episodes[since][test]} episodes: test each presented task at every test"
            )
        areas.append(area_under_curve(curve, run.episodes[since] - start))
    return np.stack(areas, axis=-1)


def success_matrix(run: Run) -> Values:
    """Return ``R[i, j]``, the success on task j at the end of phase i, ``[S, T, T]``.

    Success is the mean over as many evaluations as the last fifth of the shortest phase has, at
    least one; NaN for tasks that have not been presented.

    Raises:
        ValueError: If tasks do not start one after the other, or a phase has no test of its task.
    """
    ends = [*run.starts[1:], run.last]
    shortest = min(np.subtract(ends, run.starts).tolist())
    if shortest <= 0:
        raise ValueError(
            f"{run.directory} starts its tasks at {run.starts}: only for tasks one after the other"
        )
    window = max(run.eval_every, shortest // 5)
    matrix = evaluation_matrix(run, ends, window)
    if np.isnan(np.diagonal(matrix, axis1=-2, axis2=-1)).any():
        raise ValueError(
            f"{run.directory} has no test of a task in the last {window} episodes of its phase: "
            "let it be tested more often"
        )
    return matrix


def forgetting(matrix: Values) -> Values:
    """Return the loss of success since the end of a task's own phase, ``[..., T]``.

    ``R[j, j] - R[T - 1, j]`` of a `success_matrix`; 0 for the last task.
    """
    return np.diagonal(matrix, axis1=-2, axis2=-1) - matrix[..., -1, :]


def trials_to(success: ArrayLike, threshold: float = 0.5, *, window: int = 20) -> float:
    """Return the number of its own training episodes that a task takes to reach a success rate.

    ``success`` ``[N]`` are the outcomes of these episodes in order. The rate is taken over the
    latest ``window`` of them, and undefined for fewer; infinity if it is never reached.
    """
    won = np.concatenate([[0.0], np.cumsum(np.asarray(success, float))])
    reached = won[window:] - won[:-window] >= threshold * window
    return float(reached.argmax() + window) if reached.any() else float("inf")


def own_episodes(run: Run, threshold: float = 0.5) -> Values | None:
    """Return the training episodes of each task until a rate of them succeed, ``[S, T]``.

    See `trials_to`; infinite where that was not reached. None without training episodes on record.
    """
    if run.training is None or run.training.empty:
        return None
    table = run.training.sort_values(["seed", "episode"])
    table = table[table["episode"] <= run.last]
    times = table.groupby(["seed", "task"])["success"].agg(trials_to, threshold)
    found = run.by_seed_and_task(times)
    return np.where(np.isnan(found), np.inf, found)


def success_steps(run: Run) -> Values:
    """Return the mean steps of the successful tests in the last 10 % of training, ``[S, T]``.

    NaN for tasks without a success, and in runs without the steps of tests.
    """
    late = run.tests["episode"] > run.last - late_window(run)
    won = run.tests[late & (run.tests["success"] == 1)]
    return run.by_seed_and_task(won.groupby(["seed", "task"])["steps"].mean())


def demonstrated_steps(run: Run) -> Values:
    """Return the mean steps of the demonstrations of each task, ``[T]``; NaN where unknown."""
    steps = run.summary.get("demonstrated_steps") or {}
    return np.array([steps.get(task, np.nan) for task in run.tasks], float)


def final_means(run: Run, kind: str, column: str) -> Values | None:
    """Return a column of the final tests, ``[S, T]``; None without tests or without its values.

    Args:
        run: The run.
        kind: ``seen`` or ``held-out``, the demonstrations of the tests.
        column: ``success``, ``steps`` (NaN for tasks without a success) or ``task_inference``.

    Raises:
        ValueError: If the file lacks tests of a seed and task.
    """
    if run.final is None:
        return None
    found = run.final[run.final["demonstrations"] == kind].groupby(["seed", "task"])
    if np.isnan(run.by_seed_and_task(found.size())).any():
        raise ValueError(
            f"{run.directory / 'final.csv'} lacks tests with {kind} demonstrations: remove it and "
            "resume the run"
        )
    values = run.by_seed_and_task(found[column].mean())
    return None if np.isnan(values).all() else values


def expected_own_episodes(run: Run, task: int, episodes: ArrayLike) -> Values:
    """Return the expected number of a task's own training episodes after ``episodes`` ``[E]``.

    An episode is of each task presented so far with equal probability; if earlier tasks are not
    practised, of each of the newest.
    """
    begun, practised = run.starts, run.schedule == "practised"
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

    ``(area - reference) / (1 - reference)`` of the areas of `own_areas`, means over seeds, as in
    Continual World (Wolczyk et al., 2021): 1 for success from the start, 0 for no gain, negative
    for slower learning. The interval is Welch's of the seeds' contributions to first order (the
    delta method), so that the seeds of the reference count, too. None if the reference leaves
    nothing to gain on a task, or a task has no test in its phase.
    """
    ours, theirs = own_areas(run, reference)
    if np.isnan(ours).any():
        return None
    area, height = ours.mean(0), theirs.mean(0)
    left = 1 - height
    if (left < 1e-9).any():  # a mean of equal areas may differ from 1 in its last digit
        return None
    gained = contrast((ours / left).mean(-1), (theirs * (1 - area) / left**2).mean(-1))
    # Not the difference of the contributions, but it has their interval.
    shift = float(((area - height) / left).mean()) - gained.value
    return Estimate(*(bound + shift for bound in gained))


def own_areas(run: Run, reference: Run) -> tuple[Values, Values]:
    """Return the areas under each task's curves of a run and a reference, ``[S, T - 1]`` each.

    The mean height of a task's curve from the first to the last test of its own phase. As an
    episode is of any of the presented tasks, curves are over the expected number of the task's own
    episodes, and the reference's is read off at the tests of the run: learners with the same curve
    have the same area. NaN for a task without a test in its phase. The first task is left out,
    since nothing precedes it. Tasks of the reference may have another order.
    """
    begun, areas = run.starts, []
    for task, end in enumerate([*begun[2:], run.last], 1):
        own, curves = _own_curves(run, task, end)
        of_reference, others = _own_curves(reference, reference.tasks.index(run.tasks[task]))
        if not len(own):
            areas.append([np.full(len(one.seeds), np.nan) for one in (run, reference)])
            continue
        last = min(own[-1], of_reference[-1])
        first = min(max(own[0], of_reference[0]), last)
        tests = np.array([first, *own[(own > first) & (own < last)], last])
        areas.append((_mean_height(tests, own, curves), _mean_height(tests, of_reference, others)))
    ours, theirs = zip(*areas, strict=True)
    return np.stack(ours, axis=-1), np.stack(theirs, axis=-1)


def _own_curves(run: Run, task: int, end: int | None = None) -> tuple[Values, Values]:
    """Return a task's expected own episodes at its tests, ``[E]``, and the curves, ``[S, E]``.

    Tests after episode ``end`` are left out.
    """
    own = expected_own_episodes(run, task, run.episodes)
    played = np.diff(own, prepend=0.0) > 0
    if end is not None:
        played &= run.episodes <= end
    return own[played], run.success[:, played, task]


def _mean_height(tests: Values, episodes: Values, curves: Values) -> Values:
    """Return the mean height of curves between the first and the last of some episodes, ``[S]``."""
    heights = np.stack([np.interp(tests, episodes, curve) for curve in curves])
    if tests[0] == tests[-1]:  # a single test
        return heights[:, -1]
    return np.trapezoid(heights, tests, axis=-1) / (tests[-1] - tests[0])
