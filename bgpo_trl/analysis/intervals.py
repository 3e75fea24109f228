"""Means of scores, their confidence intervals (bootstrap and Student's t), and of differences."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import stdtrit

Array = NDArray[np.float64]
Statistic = Callable[[Array], Array]
"""Maps samples of scores, ``[N, S, T]``, to a value of each, ``[N]``, or to several."""


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


def means(samples: Array) -> Array:
    """Return the mean of each sample, ``[N]`` from ``[N, S, T]``."""
    return samples.mean(axis=(1, 2))


def stratified_bootstrap(
    scores: ArrayLike,
    statistic: Statistic = interquartile_means,
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


def t_interval(values: ArrayLike, confidence: float = 0.95) -> tuple[float, float]:
    """Return Student's t interval of the mean of values ``[N]``, one of each seed.

    Raises:
        ValueError: If there are fewer than two values, or ``confidence`` is not in (0, 1).

    Example:
        >>> [round(end, 3) for end in t_interval([0.5, 0.7, 0.6])]
        [0.352, 0.848]
    """
    found = np.asarray(values, float)
    if found.ndim != 1 or len(found) < 2 or not 0 < confidence < 1:
        raise ValueError(
            "an interval needs the values of at least two seeds and a confidence in (0, 1), got "
            f"{list(found.shape)} and {confidence}"
        )
    error = found.std(ddof=1) / np.sqrt(len(found))
    half = float(stdtrit(len(found) - 1, (1 + confidence) / 2) * error)
    return float(found.mean()) - half, float(found.mean()) + half


class Statistics:
    """Bootstrap statistics; each set of scores has its own stream of random numbers.

    Intervals of a run thus do not depend on the other runs.
    """

    def __init__(self, seed: int = 0) -> None:
        self._seed = seed
        self._drawn: dict[tuple[Statistic, bytes], Array] = {}

    def resampled(self, scores: Array, statistic: Statistic = interquartile_means) -> Array:
        """Return a statistic of resampled scores, by default interquartile means."""
        key = scores.tobytes()
        if (statistic, key) not in self._drawn:
            rng = np.random.default_rng([self._seed, zlib.crc32(key)])
            drawn = stratified_bootstrap(scores, statistic, rng=rng)
            self._drawn[statistic, key] = drawn
        return self._drawn[statistic, key]

    def cell(self, scores: Array, statistic: Statistic = interquartile_means) -> str:
        """Format a statistic of scores with its interval, in percent."""
        (middle,) = statistic(scores[None])
        return percent_cell(middle, self.resampled(scores, statistic))

    def difference(self, *scores: Array, statistic: Statistic = interquartile_means) -> Difference:
        """Return the difference of a statistic between two runs' scores, with its interval.

        Of four runs: the difference between the first two minus that between the last two.
        """
        gain = _difference([float(statistic(of_run[None])[0]) for of_run in scores])
        drawn = _difference([self.resampled(of_run, statistic) for of_run in scores])
        return Difference(gain, *percentile_interval(drawn))


class Difference(NamedTuple):
    """A difference of success between runs, and its 95 % interval."""

    gain: float
    low: float
    high: float

    def cell(self) -> str:
        """Format the difference and its interval, in points."""
        return f"{100 * self.gain:+.1f} [{100 * self.low:+.0f}, {100 * self.high:+.0f}]"


def percent_cell(value: float, resampled: Array) -> str:
    """Format a value and the interval of its resamples, in percent."""
    low, high = percentile_interval(resampled)
    return f"{_percent(value, 1)} [{_percent(low, 0)}, {_percent(high, 0)}]"


def _checked(scores: ArrayLike) -> Array:
    scores = np.asarray(scores, float)
    if scores.ndim != 2 or not scores.size or not np.isfinite(scores).all():
        raise ValueError(
            f"scores must be finite and [seeds, tasks], at least one of each, not of shape "
            f"{list(scores.shape)}{'' if np.isfinite(scores).all() else ' with NaN or Inf'}"
        )
    return scores


def _difference(values: list[Any]) -> Any:
    gap = values[0] - values[1]
    return gap if len(values) == 2 else gap - (values[2] - values[3])


def _percent(share: float, digits: int) -> str:
    # Adding 0 turns -0.0 into 0.0.
    return f"{round(100 * share, digits) + 0.0:.{digits}f}"
