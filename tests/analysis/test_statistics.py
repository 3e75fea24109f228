"""Intervals, tests and verdicts against formulas, enumeration and simulation."""

import numpy as np
import pytest
from scipy import stats

from bgpo_trl.analysis import statistics

RNG = np.random.default_rng(0)
FIRST, SECOND = RNG.normal(0.8, 0.05, 5), RNG.normal(0.7, 0.1, 7)


def test_the_interval_of_a_mean_is_students():
    by_hand = statistics.mean([0.7, 0.8, 0.9])
    # Standard error 0.1 / sqrt(3), quantile of t with two degrees of freedom 4.3027.
    assert by_hand == pytest.approx((0.8, 0.8 - 0.2484, 0.8 + 0.2484), abs=1e-4)


def test_a_difference_has_welchs_intervals():
    found = statistics.difference(FIRST, SECOND)
    one, other = FIRST.var(ddof=1) / 5, SECOND.var(ddof=1) / 7
    freedom = (one + other) ** 2 / (one**2 / 4 + other**2 / 6)  # Welch and Satterthwaite
    value, error = FIRST.mean() - SECOND.mean(), np.sqrt(one + other)
    for estimate, quantile in (found.estimate, 0.975), (found.narrow, 0.95):
        half = error * stats.t.ppf(quantile, freedom)
        assert estimate == pytest.approx((value, value - half, value + half))


def test_equal_scores_give_no_interval_and_no_verdict():
    """But for a difference to scores that are not equal."""
    for scores in ([0.8, 0.8, 0.8], [0.9, 0.9]):
        found = statistics.difference([0.9, 0.9], scores)
        assert np.isnan(found.estimate[1:]).all() and found.verdict == "not decided"
    assert statistics.mean([0.9, 0.9]).percent() == "90.0"
    assert statistics.difference([0.9, 0.9], [0.5, 0.501, 0.5]).verdict == "above"


def test_a_single_seed_gives_no_interval_and_no_verdict():
    found = statistics.difference([0.9], [0.1, 0.2])
    assert found.estimate.points() == "+75.0"
    assert found.verdict == "not decided"
    assert np.isnan(statistics.permutation_p([0.9], [0.1, 0.2]))
    assert statistics.mean([0.5]).percent() == "50.0"


@pytest.mark.parametrize(
    ("low", "high", "narrow", "verdict"),
    [
        (0.01, 0.2, (0.02, 0.19), "above"),
        (-0.2, -0.01, (-0.19, -0.02), "below"),
        (-0.06, 0.03, (-0.049, 0.02), "equivalent"),
        (-0.03, 0.06, (-0.02, 0.05), "not decided"),
        (-0.2, 0.3, (-0.1, 0.2), "not decided"),
        (0.001, 0.04, (0.005, 0.035), "equivalent (above)"),
        (-0.04, -0.001, (-0.035, -0.005), "equivalent (below)"),
    ],
)
def test_the_verdict_follows_from_the_intervals(low, high, narrow, verdict):
    middle = (low + high) / 2
    estimate = statistics.Estimate(middle, low, high)
    found = statistics.Difference(estimate, statistics.Estimate(middle, *narrow))
    assert found.verdict == verdict


def test_estimates_are_rounded_and_clipped():
    assert statistics.Estimate(0.98, 0.94, 1.02).percent() == "98.0 [94, 100]"
    assert statistics.Estimate(0.02, -0.02, 0.06).percent() == "2.0 [0, 6]"
    assert statistics.Estimate(-0.0001, -0.1, 0.104).points() == "+0.0 [-10, +10]"
    assert statistics.Estimate(0.0123, -0.001, 0.02).points() == "+1.2 [+0, +2]"


@pytest.mark.parametrize("scores", [[], [[0.5]], [0.5, np.nan], [np.inf], 0.5])
def test_missing_scores_are_refused(scores):
    for call in (statistics.mean, lambda s: statistics.difference([0.1, 0.2], s)):
        with pytest.raises(ValueError, match="scores must be finite, one for each"):
            call(scores)
