"""Measures against numbers worked out by hand."""

import numpy as np
import pytest

from bgpo_trl.analysis import metrics

NAN = np.nan
# Two tasks in the order of their presentation, evaluated after 10, 20, 30 and 40 episodes; task 2
# comes in after 20.
EPISODES = [10, 20, 30, 40]
SUCCESS = np.array([[0.0, NAN], [0.8, NAN], [0.6, 0.0], [0.4, 0.5]])


def test_evaluation_matrix_by_hand():
    last_only = metrics.evaluation_matrix(SUCCESS, EPISODES, [20, 40], window=10)
    np.testing.assert_allclose(last_only, [[0.8, NAN], [0.4, 0.5]])
    both = metrics.evaluation_matrix(SUCCESS, EPISODES, [20, 40], window=20)
    np.testing.assert_allclose(both, [[0.4, NAN], [0.5, 0.25]])


def test_each_seed_is_measured_separately():
    seeds = np.stack([SUCCESS, 0.5 * SUCCESS, np.nan_to_num(SUCCESS)])
    matrix = metrics.evaluation_matrix(seeds, EPISODES, [20, 40], window=10)
    assert matrix.shape == (3, 2, 2)
    transfer = [metrics.backward_transfer(of_seed) for of_seed in matrix]
    np.testing.assert_allclose(metrics.backward_transfer(matrix), transfer)
    best = [metrics.forgetting_since_best(of_seed) for of_seed in seeds]
    np.testing.assert_allclose(metrics.forgetting_since_best(seeds), best)


def test_backward_transfer_by_hand():
    matrix = [[0.8, NAN, NAN], [0.7, 0.9, NAN], [0.4, 1.0, 0.3]]
    # Task 1 has lost 0.4, task 2 has gained 0.1; of task 3 nothing can be said.
    assert metrics.backward_transfer(matrix) == pytest.approx([-0.4, 0.1])
    with pytest.raises(ValueError, match="one phase per task"):
        metrics.backward_transfer(matrix[1:])


def test_forgetting_since_the_best_so_far_by_hand():
    # Task 1 was at 0.8 and is at 0.4; task 2 is at its best.
    assert metrics.forgetting_since_best(SUCCESS) == pytest.approx((0.4 + 0) / 2)
    assert metrics.forgetting_since_best(SUCCESS[:1]) == 0  # a task never tested is left out


def test_a_success_of_zero_is_not_treated_as_missing():
    matrix = [[0.8, NAN], [0.0, 0.5]]
    assert metrics.backward_transfer(matrix) == pytest.approx([-0.8])
    assert metrics.presented_mean([[0.0, NAN], [0.0, 1.0]]).tolist() == [0, 0.5]
    assert metrics.trailing_mean([[1.0], [0.0]], 2).tolist() == [[1], [0.5]]
    assert metrics.area_under_curve([0.0, 0.0], [10, 20]) == 0
    assert metrics.forgetting_since_best([[0.6], [0.0]]) == 0.6


def test_area_under_curve_by_hand():
    # Triangle to 10, then two trapezoids; the last interval is twice as long.
    area = (10 * 0.2 + 10 * (0.4 + 0.8) / 2 + 20 * (0.8 + 0.6) / 2) / 40
    assert metrics.area_under_curve([0.4, 0.8, 0.6], [10, 20, 40]) == pytest.approx(area)
    several = metrics.area_under_curve([[0.4, 0.8, 0.6], [1, 1, 1]], [10, 20, 40])
    assert several.tolist() == pytest.approx([area, 1 - 10 * 0.5 / 40])


def test_episodes_to_a_threshold():
    curves = [[0.1, 0.8, 0.2], [0.9, 0.9, 0.9], [0.0, 0.7, 0.79]]
    assert metrics.episodes_to(curves, [10, 20, 30]).tolist() == [20, 10, np.inf]
    assert metrics.episodes_to(curves, [10, 20, 30], 0.7).tolist() == [20, 10, 20]


def test_episodes_until_overall_success_reaches_a_rate():
    # By evaluation and task, of two seeds. Means over seeds and presented tasks: 1/2, 1, 1, then
    # the second task comes in at 0 and is done.
    seeds = np.ones((2, 5, 2))
    seeds[:, :3, 1], seeds[:, 3, 1], seeds[0, 0, 0] = NAN, 0, 0
    episodes = np.array([10, 20, 30, 40, 50])
    # Over three evaluations: 1/2, 3/4, 5/6, (1 + 0) / 2, (1 + 1/2) / 2.
    assert metrics.overall_episodes_to(seeds, episodes) == 30
    assert metrics.overall_episodes_to(seeds, episodes, 0.7) == 20
    assert metrics.overall_episodes_to(seeds[:, :2], episodes[:2]) == np.inf


def test_own_episodes_until_half_of_the_last_twenty_succeed():
    # The tenth success is the thirteenth episode, but twenty are needed for a rate.
    early = [0, 0, 0] + [1] * 10 + [0] * 7
    assert metrics.trials_to(early) == 20
    # 9 of episodes 1 to 20 succeed and 9 of 2 to 21; of 3 to 22, 10 do.
    late = [0, 0] + [0, 1] * 9 + [0, 1]
    assert metrics.trials_to(late) == 22
    assert metrics.trials_to(late[:-1]) == np.inf
    assert metrics.trials_to([1] * 19) == metrics.trials_to([]) == np.inf


def test_another_rate_over_another_window():
    outcomes = [1, 0, 1, 0, 1, 1, 1, 1, 0]
    assert metrics.trials_to(outcomes, 0.8, window=5) == 7  # episodes 3 to 7
    assert metrics.trials_to(outcomes, 1.0, window=2) == 6
    assert metrics.trials_to(outcomes, window=1) == 1
    with pytest.raises(ValueError, match="at least 1 episode, not 0"):
        metrics.trials_to(outcomes, window=0)


def test_learning_times_relative_to_the_first_task():
    inf = np.inf
    seeds = [[100, 50, 300], [40, 40, inf], [50, 100, 100]]
    # By seed 0.5, 1 and 2; 3, never and 2.
    assert metrics.times_the_first(seeds).tolist() == [1, 3]
    # A seed without the first task says nothing; half of the others never learn the third.
    assert metrics.times_the_first([*seeds[:2], [inf, 20, 20]]).tolist() == [0.75, inf]
    np.testing.assert_array_equal(metrics.times_the_first([[inf, 20, inf]]), [NAN, NAN])


def test_forward_transfer_by_hand():
    gained = metrics.forward_transfer([1.0, 0.5, 0.25], 0.5)
    assert gained.tolist() == [1, 0, -0.5]


def test_trailing_mean_by_hand():
    np.testing.assert_allclose(
        metrics.trailing_mean(SUCCESS, 3),
        [[0, NAN], [0.4, NAN], [1.4 / 3, 0], [0.6, 0.25]],
    )
    np.testing.assert_array_equal(metrics.trailing_mean(SUCCESS, 1), SUCCESS)
