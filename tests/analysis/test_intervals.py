"""Interquartile means by hand, and their intervals against what theory promises."""

import numpy as np
import pytest

from bgpo_trl.analysis import intervals

NAN = np.nan


def test_interquartile_mean_by_hand():
    assert intervals.interquartile_mean([0, 0, 0, 1]) == 0  # zero is a score
    # A quarter of eight is two at each end.
    assert intervals.interquartile_mean([[9, 3, 1, 2], [8, 0, 100, 4]]) == (3 + 4 + 2 + 8) / 4
    assert intervals.interquartile_mean([1, 2, 30]) == 11  # three have no quarter to cut
    assert intervals.interquartile_mean([5, 1, 2, 3, 4, 40]) == (2 + 3 + 4 + 5) / 4


def test_the_mean_of_each_sample_is_that_of_it_alone():
    samples = np.random.default_rng(5).normal(size=(20, 3, 5))
    alone = [intervals.interquartile_mean(sample) for sample in samples]
    np.testing.assert_allclose(intervals.interquartile_means(samples), alone, rtol=1e-12)


def test_resampling_draws_seeds_for_each_task_by_itself():
    scores = np.array([[0.0, 10.0], [1.0, 11.0]])
    seen = set()

    def collect(drawn):
        assert drawn.shape == (500, 2, 2)
        assert set(drawn[..., 0].flat) == {0, 1}
        assert set(drawn[..., 1].flat) == {10, 11}
        seen.update(map(tuple, drawn.reshape(500, 4)))
        return drawn[:, 0, 0]

    intervals.stratified_bootstrap(scores, collect, n_resamples=500, rng=np.random.default_rng(0))
    assert len(seen) == 16  # any seed with any other


def test_the_interval_of_a_mean_is_that_of_theory():
    rng = np.random.default_rng(1)
    scores = rng.normal(size=(400, 1))
    drawn = intervals.stratified_bootstrap(
        scores, lambda samples: samples.mean((1, 2)), n_resamples=4_000, rng=rng
    )
    low, high = intervals.percentile_interval(drawn)
    error = scores.std() / np.sqrt(400)
    assert [low, high] == pytest.approx(
        [scores.mean() - 1.96 * error, scores.mean() + 1.96 * error], abs=0.15 * error
    )
    narrow = intervals.percentile_interval(drawn, confidence=0.5)
    assert narrow == pytest.approx(
        (scores.mean() - 0.674 * error, scores.mean() + 0.674 * error), abs=0.15 * error
    )


def test_intervals_follow_from_the_generator():
    scores = np.random.default_rng(2).random((5, 3))
    draws = [
        intervals.stratified_bootstrap(scores, rng=np.random.default_rng(seed))
        for seed in (0, 0, 1)
    ]
    assert draws[0].tolist() == draws[1].tolist() != draws[2].tolist()
    assert draws[0].shape == (2_000,)


def test_t_intervals_are_those_of_the_table():
    # Values of t for 95 %: 12.706 for one degree of freedom, 2.776 for four.
    assert intervals.t_interval([0.4, 0.6]) == pytest.approx((0.5 - 1.2706, 0.5 + 1.2706), abs=1e-4)
    values = [0.1, 0.2, 0.3, 0.4, 0.5]
    half = 2.776 * np.sqrt(0.025 / 5)
    assert intervals.t_interval(values) == pytest.approx((0.3 - half, 0.3 + half), abs=1e-4)
    assert intervals.t_interval([0.5, 0.5, 0.5]) == (0.5, 0.5)
    low, high = intervals.t_interval(values, 0.5)
    assert high - low == pytest.approx(2 * 0.741 * np.sqrt(0.025 / 5), abs=1e-4)


@pytest.mark.parametrize("scores", [[0.5], [[0.5, NAN]], [[0.5, np.inf]], np.zeros((0, 3))])
def test_scores_that_are_not_there_are_refused(scores):
    with pytest.raises(ValueError, match=r"finite and \[seeds, tasks\]"):
        intervals.stratified_bootstrap(scores, rng=np.random.default_rng(0))


def test_rliable_agrees():
    metrics_of_rliable = pytest.importorskip("rliable.metrics", reason="rliable is not needed")
    library = pytest.importorskip("rliable.library", reason="rliable is not needed")
    scores = np.random.default_rng(3).random((10, 3))
    ours = intervals.interquartile_mean(scores)
    assert ours == pytest.approx(float(metrics_of_rliable.aggregate_iqm(scores)))
    _, theirs = library.get_interval_estimates(
        {"x": scores}, lambda x: np.array([metrics_of_rliable.aggregate_iqm(x)]), reps=5_000
    )
    rng = np.random.default_rng(4)
    drawn = intervals.stratified_bootstrap(scores, n_resamples=5_000, rng=rng)
    width = np.ptp(theirs["x"])
    assert intervals.percentile_interval(drawn) == pytest.approx(
        theirs["x"].ravel(), abs=0.06 * width
    )
