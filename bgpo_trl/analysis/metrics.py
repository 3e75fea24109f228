"""Measures of multi-task and continual learning.

All functions take plain arrays. ``success`` ``[..., E, T]`` is the share of successes on each of
``T`` tasks at each of ``E`` evaluations (`bgpo_trl.runs.results.Curves` adds a leading seed
dimension). NaN marks tasks that were not tested, because they had not been presented yet.
``episodes`` ``[E]`` are the training episodes before each evaluation. ``ValueError`` is raised if
they do not increase, or shapes do not match.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def in_window(episodes: ArrayLike, end: int, window: int) -> NDArray[np.bool_]:
    """Return which ``episodes`` ``[E]`` are among the last ``window`` until ``end``, ``[E]``."""
    episodes = np.asarray(episodes)
    return (episodes > end - window) & (episodes <= end)


def evaluation_matrix(
    success: ArrayLike, episodes: ArrayLike, ends: ArrayLike, *, window: int
) -> Array:
    """Return ``R[i, j]``, the success on task j at the end of phase i, ``[..., P, T]``.

    ``ends`` ``[P]`` are the last episodes of the phases: the starts of the later tasks, and the end
    of training. Success is the mean over the evaluations in the ``window`` episodes before an end;
    NaN for tasks without a test among them.

    Raises:
        ValueError: If a phase has no evaluation in its window.
    """
    success, episodes = np.asarray(success, float), np.asarray(episodes)
    _check_episodes(success, episodes, -2)
    phases = []
    for end in np.asarray(ends).tolist():
        chosen = in_window(episodes, end, window)
        if not chosen.any():
            raise ValueError(
                f"there is no evaluation in the {window} episodes before episode {end}: test "
                "more often, or for a longer run"
            )
        phases.append(_mean(success[..., chosen, :], axis=-2))
    return np.stack(phases, axis=-2)


def change_since_learned(matrix: ArrayLike) -> Array:
    """Return each task's change of success since the end of its own phase, ``[..., T]``.

    ``R[T - 1, j] - R[j, j]``, where phase j introduces task j.

    Args:
        matrix: Result of `evaluation_matrix` with one phase per task, ``[..., T, T]``.

    Raises:
        ValueError: If the numbers of phases and tasks differ.
    """
    matrix = np.asarray(matrix, float)
    if matrix.shape[-1] != matrix.shape[-2]:
        raise ValueError(f"matrix must have one phase per task, got {list(matrix.shape[-2:])}")
    return matrix[..., -1, :] - np.diagonal(matrix, axis1=-2, axis2=-1)


def forgetting_since_best(success: ArrayLike) -> Array:
    """Return the loss of success since each task's best evaluation, ``[...]``.

    The mean over tasks of the highest success at any evaluation minus that at the last one; never
    negative (Chaudhry et al., 2018, "Riemannian Walk for Incremental Learning", but over all
    evaluations and tasks). Noise of single evaluations counts as forgetting: average ``success``
    ``[..., E, T]`` first with `trailing_mean`.
    """
    success = np.asarray(success, float)
    _check_episodes(success, np.arange(success.shape[-2] if success.ndim > 1 else 0), -2)
    # Unlike np.nanmax, it does not warn of tasks without a test.
    best = np.fmax.reduce(success, axis=-2)
    return _mean(best - success[..., -1, :], axis=-1)


def backward_transfer(matrix: ArrayLike) -> Array:
    """Return the gain of each task but the last from learning later ones, ``[..., T - 1]``.

    `change_since_learned` of these tasks; its mean over them is the measure of Lopez-Paz & Ranzato
    (2017, "Gradient Episodic Memory for Continual Learning").
    """
    return change_since_learned(matrix)[..., :-1]


def forward_transfer(area: ArrayLike, reference: ArrayLike) -> Array:
    """Return the gain in learning a task from having learned other tasks before.

    ``(area - reference) / (1 - reference)``: 1 for success from the start, 0 for no gain, negative
    for slower learning (Wolczyk et al., 2021, "Continual World"). ``area`` is the
    mean height of a task's curve since its presentation; ``reference`` is the same, over as many
    episodes, of a learner without earlier tasks.
    """
    area, reference = np.asarray(area, float), np.asarray(reference, float)
    return (area - reference) / (1 - reference)


def area_under_curve(success: ArrayLike, episodes: ArrayLike) -> Array:
    """Return the mean height of learning curves ``[..., E]``, between 0 and 1, ``[...]``.

    Integrates by trapezoids; before the first evaluation, the curve rises linearly from 0 at
    episode 0. Curves must not contain NaN.
    """
    success, episodes = np.asarray(success, float), np.asarray(episodes, float)
    _check_episodes(success, episodes, -1)
    start = np.zeros((*success.shape[:-1], 1))
    heights = np.concatenate([start, success], axis=-1)
    return np.trapezoid(heights, np.concatenate([[0.0], episodes]), axis=-1) / episodes[-1]


def episodes_to(success: ArrayLike, episodes: ArrayLike, threshold: float = 0.8) -> Array:
    """Return the training episodes until curves ``[..., E]`` first reach a success rate, ``[...]``.

    Infinite where the rate is never reached.
    """
    _check_episodes(np.asarray(success, float), np.asarray(episodes), -1)
    reached = np.asarray(success, float) >= threshold
    first = np.asarray(episodes, float)[reached.argmax(axis=-1)]
    return np.where(reached.any(axis=-1), first, np.inf)


def overall_episodes_to(success: ArrayLike, episodes: ArrayLike, threshold: float = 0.8) -> float:
    """Return the training episodes until overall success first reaches a rate, else infinity.

    Overall success is the mean over seeds and the tasks presented so far, and over the last three
    evaluations, since a single one has few test episodes. ``success`` is ``[S, E, T]``.
    """
    overall = presented_mean(trailing_mean(success, 3)).mean(axis=0)
    return float(episodes_to(overall, episodes, threshold))


def trials_to(success: ArrayLike, threshold: float = 0.5, *, window: int = 20) -> float:
    """Return the number of its own training episodes that a task takes to reach a success rate.

    ``success`` ``[N]`` are the outcomes of these episodes in order. The rate is taken over the
    latest ``window`` of them, and undefined for fewer; infinity if it is never reached.

    Raises:
        ValueError: If the window is empty.
    """
    if window < 1:
        raise ValueError(f"window must be at least 1 episode, not {window}")
    won = np.concatenate([[0.0], np.cumsum(np.asarray(success, float))])
    reached = won[window:] - won[:-window] >= threshold * window
    return float(reached.argmax() + window) if reached.any() else float("inf")


def times_the_first(episodes: ArrayLike) -> Array:
    """Return the learning times of the later tasks as multiples of the first task's, ``[T - 1]``.

    The median over seeds of `trials_to` ``[S, T]``, with tasks in order of presentation. A task
    that a seed never learns counts as infinitely long. Seeds that never learn the first task are
    left out; NaN if none is left.
    """
    episodes = np.asarray(episodes, float)
    learned = episodes[np.isfinite(episodes[:, 0])]
    if not len(learned):
        return np.full(episodes.shape[1] - 1, np.nan)
    return np.median(learned[:, 1:] / learned[:, :1], axis=0)


def trailing_mean(success: ArrayLike, n: int) -> Array:
    """Return the mean of each evaluation and up to ``n - 1`` before it, ``[..., E, T]``.

    Raises:
        ValueError: If ``n`` is less than 1.
    """
    success = np.asarray(success, float)
    if n < 1 or success.ndim < 2:
        raise ValueError(f"success must be [..., E, T] and n at least 1, got {success.shape}, {n}")
    n_evaluations = success.shape[-2]
    return np.stack(
        [
            _mean(success[..., max(0, end - n) : end, :], axis=-2)
            for end in range(1, n_evaluations + 1)
        ],
        axis=-2,
    )


def presented_mean(success: ArrayLike) -> Array:
    """Return the mean of ``success`` over the tasks presented by each evaluation, ``[..., E]``."""
    return _mean(np.asarray(success, float), axis=-1)


def _check_episodes(success: Array, episodes: NDArray, axis: int) -> None:
    """Raise ``ValueError`` unless there is one episode per evaluation, in increasing order."""
    n_evaluations = success.shape[axis] if success.ndim >= -axis else 0
    if not n_evaluations or episodes.shape != (n_evaluations,) or (np.diff(episodes) <= 0).any():
        raise ValueError(
            "each evaluation needs a training episode, in increasing order: got success "
            f"{[*success.shape]} for episodes {episodes.tolist()}"
        )


def _mean(values: Array, axis: int) -> Array:
    """Return the mean of the values that are not NaN; NaN where all are."""
    return np.ma.filled(np.ma.masked_invalid(values).mean(axis), np.nan)
