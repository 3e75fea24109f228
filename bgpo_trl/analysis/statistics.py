"""Intervals, tests and verdicts about runs of several seeds.

One agent learns all tasks, so seeds are the independent observations: a seed has one score, such
as its mean success over tasks. Means have Student's t intervals, differences Welch's (1947), which
allow different spreads and numbers of seeds. Scores are shares (0 to 1), differences are formatted
in points (0 to 100).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

MARGIN = 0.05
"""Two runs count as equivalent if their difference is within this margin, stated beforehand."""
POWER = 0.8
"""Probability of a decision for which `seeds_needed` counts seeds."""
_MANY = 1_000
# More assignments of seeds to two runs than this are sampled. Eight against eight are 12,870.
_PERMUTATIONS = 20_000
_SIGNS = (1.0, -1.0, -1.0, 1.0)

Array = NDArray[np.float64]


class Estimate(NamedTuple):
    """A value with its interval; NaN bounds if a sample has a single seed."""

    value: float
    low: float
    high: float

    def percent(self) -> str:
        """Format a share in percent; bounds outside 0 and 100 are clipped."""
        low, high = max(0.0, self.low), min(1.0, self.high)
        return f"{100 * self.value:.1f}{self._bounds(low, high)}"

    def points(self) -> str:
        """Format a difference of shares in points, with its sign."""
        # Adding 0 turns -0.0 into 0.0.
        return f"{round(100 * self.value, 1) + 0.0:+.1f}{self._bounds(self.low, self.high, '+')}"

    def _bounds(self, low: float, high: float, sign: str = "") -> str:
        if math.isnan(self.low):
            return ""
        low, high = (round(100 * bound) + 0.0 for bound in (low, high))
        return f" [{low:{sign}.0f}, {high:{sign}.0f}]"


def contrast(
    samples: Sequence[ArrayLike], weights: Sequence[float], confidence: float = 0.95
) -> Estimate:
    """Return the sum of ``weights`` times the means of independent samples, with its t interval.

    Weights (1,) make a mean, (1, -1) a difference, (1, -1, -1, 1) a difference of differences. The
    degrees of freedom are by Welch and Satterthwaite. Samples are ``[S]`` each.

    Raises:
        ValueError: If a sample is empty, not finite or not a vector.
    """
    value, variances, freedoms = 0.0, [], []
    for sample, weight in zip(map(_checked, samples), weights, strict=True):
        value += weight * sample.mean()
        # The variance of a single score is unknown.
        spread = sample.var(ddof=1) if len(sample) > 1 else math.nan
        variances.append(weight**2 * spread / len(sample))
        freedoms.append(len(sample) - 1)
    error = math.sqrt(sum(variances))
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = np.square(variances) / freedoms
        freedom = float(np.float64(sum(variances)) ** 2 / shares.sum())
    # Without any spread, the degrees of freedom are 0 / 0 and the interval is a point.
    half = error and error * float(stats.t.ppf((1 + confidence) / 2, freedom))
    return Estimate(float(value), float(value) - half, float(value) + half)


def mean(scores: ArrayLike) -> Estimate:
    """Return the mean of the seeds' scores ``[S]`` with its 95 % interval.

    Raises:
        ValueError: As for `contrast`.
    """
    return contrast([scores], [1.0])


@dataclass(frozen=True)
class Difference:
    """The difference between two runs, what can be said of it, and what it would take to say more.

    For two pairs of runs, it is the difference of the pairs' differences.
    """

    estimate: Estimate
    """With its 95 % interval."""
    narrow: Estimate
    """With its 90 % interval, that of two one-sided tests of equivalence at 5 %."""
    p: float
    """Of the permutation test; NaN for two pairs, or a single seed."""
    seeds: int | None
    """Seeds a run that a decision would take, see `seeds_needed`; None if that is unknown."""

    @property
    def verdict(self) -> str:
        """``above``, ``below``, ``equivalent``, a combination of them, or ``not decided``.

        Equivalent: the 90 % interval lies within `MARGIN`. Above or below: the 95 % interval
        excludes 0. A small difference that many seeds have established is both.
        """
        side = "above" if self.estimate.low > 0 else "below" if self.estimate.high < 0 else ""
        if self.narrow.low > -MARGIN and self.narrow.high < MARGIN:
            return f"equivalent ({side})" if side else "equivalent"
        return side or "not decided"

    @property
    def note(self) -> str:
        """The verdict and, where nothing is decided, how many seeds a run it would take."""
        if self.verdict != "not decided" or self.seeds is None:
            return self.verdict
        count = f"more than {_MANY:,}" if self.seeds > _MANY else f"about {self.seeds}"
        return f"not decided ({count} seeds would)"


def difference(*samples: ArrayLike) -> Difference:
    """Return the difference of the mean scores of two runs, first minus second.

    Of four runs: the difference between the first two minus that between the last two.

    Args:
        samples: Scores of each run's seeds, ``[S]``; numbers of seeds may differ.

    Raises:
        ValueError: As for `contrast`; or if there are not two or four samples.
    """
    if len(samples) not in (2, 4):
        raise ValueError(f"a difference is of two runs or two pairs, not of {len(samples)}")
    wide, narrow = (contrast(samples, _SIGNS[: len(samples)], share) for share in (0.95, 0.9))
    p = permutation_p(samples[0], samples[1]) if len(samples) == 2 else math.nan
    return Difference(wide, narrow, p, seeds_needed(*samples))


def permutation_p(first: ArrayLike, second: ArrayLike, rng: int | np.random.Generator = 0) -> float:
    """Return the two-sided p value of a permutation test of the difference of two means.

    It is exact for up to 20,000 assignments of the seeds to the two runs, such as eight against
    eight; of more, as many are drawn. NaN if a run has a single seed.

    Args:
        first: Scores of the first run's seeds, ``[S]``.
        second: Scores of the second run's seeds; their number may differ.
        rng: Generator of the draws, or its seed.

    Raises:
        ValueError: If scores are missing or not finite.
    """
    samples = _checked(first), _checked(second)
    if min(map(len, samples)) < 2:
        return math.nan
    test = stats.permutation_test(
        samples,
        lambda a, b, axis: a.mean(axis) - b.mean(axis),
        vectorized=True,
        n_resamples=_PERMUTATIONS,
        rng=np.random.default_rng(rng),
    )
    return float(test.pvalue)


def seeds_needed(*samples: ArrayLike) -> int | None:
    """Return the number of seeds a run at which a decision is likely, a power calculation.

    If the difference and the spread of seeds are as measured, so many seeds find the runs
    equivalent, or different, with a probability of at least `POWER`. Both are uncertain with few
    seeds, and so is the result.

    Args:
        samples: Scores of the seeds of two runs or two pairs of runs, ``[S]`` each.

    Returns:
        At least 2; more than 1,000 is given as 1,001; None if a run has a single seed.

    Raises:
        ValueError: As for `contrast`.
    """
    scores = [_checked(sample) for sample in samples]
    if min(map(len, scores)) < 2:
        return None
    spreads = np.array([sample.var(ddof=1) for sample in scores])
    if not spreads.any():
        return 2
    gap = abs(contrast(scores, _SIGNS[: len(scores)]).value)
    n = np.arange(2, _MANY + 1)
    # Of runs with n seeds each, whose difference has this standard error.
    freedom = (n - 1) * spreads.sum() ** 2 / (spreads**2).sum()
    error = np.sqrt(spreads.sum() / n)
    # Two one-sided tests (Schuirmann, 1987): each bound of the margin is excluded.
    upper, lower = (
        _power(0.95, freedom, distance / error) for distance in (MARGIN - gap, MARGIN + gap)
    )
    different = _power(0.975, freedom, gap / error)
    enough = np.maximum(upper + lower - 1, different) >= POWER
    return int(n[enough.argmax()]) if enough.any() else _MANY + 1


def _power(confidence: float, freedom: Array, distance: Array) -> Array:
    """Return the power of one-sided t tests at distances from the bound in standard errors."""
    # Beyond this distance the power is 1, and SciPy's becomes NaN.
    distance = np.clip(distance, -1e3, 1e3)
    return stats.nct.sf(stats.t.ppf(confidence, freedom), freedom, distance)


def holm(p: Sequence[float]) -> list[float]:
    """Return p values adjusted for their number (Holm, 1979), in the given order; NaN stay."""
    values = np.asarray(p, float)
    order = [index for index in np.argsort(values) if not math.isnan(values[index])]
    factors = np.arange(len(order), 0, -1)
    values[order] = np.minimum(1, np.maximum.accumulate(factors * values[order]))
    return values.tolist()


def _checked(scores: ArrayLike) -> Array:
    scores = np.asarray(scores, float)
    if scores.ndim != 1 or not scores.size or not np.isfinite(scores).all():
        raise ValueError(
            "scores must be finite, one for each of one or more seeds: got shape "
            f"{list(scores.shape)}{'' if np.isfinite(scores).all() else ' with NaN or Inf'}"
        )
    return scores
