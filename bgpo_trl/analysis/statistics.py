"""Intervals, tests and verdicts about runs of several seeds.

One agent learns all tasks, so seeds are the independent observations: a seed has one score, such
as its mean success over tasks. Means have Student's t intervals, differences Welch's (1947), which
allow different spreads and numbers of seeds. Scores are shares (0 to 1), differences are formatted
in points (0 to 100).
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

MARGIN = 0.05
"""Two runs count as equivalent if their difference is within this margin, stated beforehand."""
# More assignments of seeds to two runs than this are sampled. Eight against eight are 12,870.
_PERMUTATIONS = 20_000


class Estimate(NamedTuple):
    """A value with its interval; NaN bounds if samples do not tell their spread."""

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
    sample: ArrayLike, minus: ArrayLike | None = None, *, confidence: float = 0.95
) -> Estimate:
    """Return the mean of a sample ``[S]``, or that minus the mean of another, with its t interval.

    The degrees of freedom are by Welch and Satterthwaite. Equal scores do not tell the spread, so
    samples of such alone have no interval.

    Raises:
        ValueError: If a sample is empty, not finite or not a vector.
    """
    first = _checked(sample)
    second = None if minus is None else _checked(minus)
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")  # A single score has no variance, equal ones have none.
        if second is None:
            value, test = first.mean(), stats.ttest_1samp(first, 0.0)
        else:
            value = first.mean() - second.mean()
            test = stats.ttest_ind(first, second, equal_var=False)
        low, high = test.confidence_interval(confidence)
    if not any(np.ptp(scores) for scores in (first, second) if scores is not None):
        low = high = math.nan
    return Estimate(float(value), float(low), float(high))


def mean(scores: ArrayLike) -> Estimate:
    """Return the mean of the seeds' scores ``[S]`` with its 95 % interval."""
    return contrast(scores)


@dataclass(frozen=True)
class Difference:
    """The difference between two runs."""

    estimate: Estimate
    """With its 95 % interval."""
    narrow: Estimate
    """With its 90 % interval, that of two one-sided tests of equivalence at 5 %."""

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


def difference(first: ArrayLike, second: ArrayLike) -> Difference:
    """Return the difference of the mean scores ``[S]`` of two runs, first minus second."""
    return Difference(contrast(first, second), contrast(first, second, confidence=0.9))


def permutation_p(first: ArrayLike, second: ArrayLike) -> float:
    """Return the two-sided p value of a permutation test of the difference of two means.

    It is exact for up to 20,000 assignments of the seeds to the two runs, such as eight against
    eight; of more, as many are drawn. NaN if a run has a single seed.
    """
    samples = _checked(first), _checked(second)
    if min(map(len, samples)) < 2:
        return math.nan
    test = stats.permutation_test(
        samples,
        lambda a, b, axis: a.mean(axis) - b.mean(axis),
        vectorized=True,
        n_resamples=_PERMUTATIONS,
        rng=np.random.default_rng(0),
    )
    return float(test.pvalue)


def _checked(scores: ArrayLike) -> NDArray[np.float64]:
    scores = np.asarray(scores, float)
    if scores.ndim != 1 or not scores.size or not np.isfinite(scores).all():
        raise ValueError(f"scores must be finite, one for each of one or more seeds: got {scores}")
    return scores
