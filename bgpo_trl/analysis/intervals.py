"""Interquartile means of scores, and their bootstrap confidence intervals."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def interquartile_mean(scores: ArrayLike) -> float:
    """Return the mean of the middle half of all scores (Agarwal et al., 2021, "rliable").

    Raises:
        ValueError: If there are no scores, or one is not finite.
    """
    scores = np.asarray(scores, float)
    if not scores.size or not np.isfinite(scores).all():
        raise ValueError("scores must be finite and not empty: leave out what was not tested")
    return float(interquartile_means(scores[None])[0])


def interquartile_means(samples: Array) -> Array:
    """Return the `interquartile_mean` of each sample, ``[N]`` from ``[N, ...]``."""
    ordered = np.sort(samples.reshape(len(samples), -1), axis=1)
    cut = ordered.shape[1] // 4
    return ordered[:, cut : ordered.shape[1] - cut].mean(1)


def stratified_bootstrap(
    scores: ArrayLike,
    statistic: Callable[[Array], Array] = interquartile_means,
    *,
    n_resamples: int = 2_000,
    rng: np.random.Generator,
) -> Array:
    """Return a statistic of resampled scores, ``[n_resamples]``, the basis of intervals.

    Seeds are resampled with replacement, independently for each task (Agarwal et al., 2021, "Deep
    Reinforcement Learning at the Edge of the Statistical Precipice", section 4.1). Scores are
    ``[S, T]``, one per seed and task; ``statistic`` maps resampled ones ``[N, S, T]`` to ``[N]``.

    Raises:
        ValueError: If scores are not finite or not ``[S, T]``, or ``n_resamples`` is less than 1.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> ours, theirs = [[0.9, 0.8], [0.7, 0.8]], [[0.5, 0.1], [0.3, 0.2]]
        >>> gain = stratified_bootstrap(ours, rng=rng) - stratified_bootstrap(theirs, rng=rng)
        >>> percentile_interval(gain)[0] > 0
        True
    """
    scores = _checked(scores)
    if n_resamples < 1:
        raise ValueError(f"n_resamples must be at least 1, got {n_resamples}")
    n_seeds, n_tasks = scores.shape
    drawn = rng.integers(n_seeds, size=(n_resamples, n_seeds, n_tasks))
    return statistic(scores[drawn, np.arange(n_tasks)])


def percentile_interval(values: ArrayLike, confidence: float = 0.95) -> tuple[float, float]:
    """Return the percentile bootstrap interval of resampled values, or of their differences.

    Raises:
        ValueError: If there are no values, or ``confidence`` is not in (0, 1).
    """
    if not np.size(values) or not 0 < confidence < 1:
        raise ValueError(
            "values must not be empty and confidence must be in (0, 1), got "
            f"{np.size(values)} values and {confidence}"
        )
    tail = 100 * (1 - confidence) / 2
    low, high = np.percentile(np.asarray(values, float), [tail, 100 - tail])
    return float(low), float(high)


def _checked(scores: ArrayLike) -> Array:
    scores = np.asarray(scores, float)
    if scores.ndim != 2 or not scores.size or not np.isfinite(scores).all():
        raise ValueError(
            f"scores must be finite and [seeds, tasks], at least one of each, not of shape "
            f"{list(scores.shape)}{'' if np.isfinite(scores).all() else ' with NaN or Inf'}"
        )
    return scores
