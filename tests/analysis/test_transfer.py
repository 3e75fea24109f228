"""Forward transfer against numbers worked out by hand."""

from dataclasses import replace

import numpy as np
import pytest

from bgpo_trl.analysis.scores import expected_own_episodes, forward_transfer, own_areas
from tests.analysis.runs import STARTS, SUCCESS, make_run


def test_own_episodes_are_shared_among_the_presented_tasks():
    episodes = [5, 10, 20, 30]
    # Alone until 10, one of two until 20, then one of three.
    expected = {0: [5, 10, 15, 15 + 10 / 3], 1: [0, 0, 5, 5 + 10 / 3], 2: [0, 0, 0, 10 / 3]}
    for task, own in expected.items():
        np.testing.assert_allclose(expected_own_episodes(STARTS, task, episodes), own)
    from_the_start = expected_own_episodes((0, 0, 4), 1, episodes)
    np.testing.assert_allclose(from_the_start, [2 + 1 / 3, 4, 2 + 16 / 3, 2 + 26 / 3])


def test_own_episodes_without_practice_are_those_of_the_own_phase():
    episodes = [5, 10, 20, 30]
    expected = {0: [5, 10, 10, 10], 1: [0, 0, 10, 10], 2: [0, 0, 0, 10]}
    for task, own in expected.items():
        found = expected_own_episodes(STARTS, task, episodes, practised=False)
        np.testing.assert_allclose(found, own)
    two = expected_own_episodes((0, 4, 4), 2, episodes, practised=False)
    np.testing.assert_allclose(two, [0.5, 3, 8, 13])


def test_areas_without_practice_end_with_the_own_phase():
    run = make_run()
    run.config["schedule"] = "sequential"
    ours, theirs = own_areas(run, make_run(RISING, (0, 0, 0)))
    # Task b: 0.4 after 5 own episodes, 0.6 after 10; task c: 0 and 0.4.
    np.testing.assert_allclose(ours, [[0.5, 0.2]] * 2)
    np.testing.assert_allclose(theirs, [[0.6, 0.6]] * 2)


# The reference plays each task in every third episode, all alike: after 5/3, 10/3, 5, ... own
# episodes.
RISING = [[0.3] * 3, *[[0.6] * 3] * 5]


def test_areas_are_over_the_own_episodes_between_the_tests_of_a_phase():
    ours, theirs = own_areas(make_run(), make_run(RISING, (0, 0, 0), "cba"))
    # Task b: 0.4 after 2.5 own episodes, 0.6 after 5; task c: 0 after 5/3, 0.4 after 10/3.
    np.testing.assert_allclose(ours, [[0.5, 0.2]] * 2)
    # The reference is at 0.45 after 2.5 and at 0.6 after 5; at 0.3 after 5/3 and at 0.6 after 10/3.
    np.testing.assert_allclose(theirs, [[(0.45 + 0.6) / 2, 0.45]] * 2)


def test_forward_transfer_is_the_share_gained_of_what_is_left_to_gain():
    gain = forward_transfer(make_run(), make_run(RISING, (0, 0, 0)))
    expected = ((0.5 - 0.525) / (1 - 0.525) + (0.2 - 0.45) / (1 - 0.45)) / 2
    assert gain == pytest.approx([expected] * 3)  # the seeds are equal
    assert forward_transfer(make_run(), make_run(np.ones((6, 3)), (0, 0, 0))) is None


@pytest.mark.parametrize("curve", [lambda own: 0 * own + 0.8, lambda own: np.minimum(own / 9, 1)])
def test_a_learner_gains_nothing_if_its_tasks_are_learned_alike_in_any_order(curve):
    episodes = 5 * np.arange(1, 25)

    def learner(starts):
        own = [expected_own_episodes(starts, task, episodes) for task in range(3)]
        success = [np.where(of_task > 0, curve(of_task), np.nan) for of_task in own]
        return make_run(np.stack(success, -1), starts)

    gain = forward_transfer(learner((0, 40, 80)), learner((0, 0, 0)))
    assert gain.value == pytest.approx(0, abs=0.01)


def test_a_single_test_of_a_phase_is_its_area():
    run = make_run(SUCCESS[:5])  # of task c after 25 episodes
    ours, theirs = own_areas(run, make_run(RISING, (0, 0, 0)))
    np.testing.assert_allclose(ours[:, 1], 0)
    np.testing.assert_allclose(theirs[:, 1], 0.3)


def test_seeds_of_run_and_reference_widen_the_interval():
    run, reference = make_run(), make_run(RISING, (0, 0, 0))
    for widened, less in ((run, 0.1), (reference, 0.2)):
        before = forward_transfer(run, reference)
        widened.curves.success[1] -= less
        after = forward_transfer(run, reference)
        assert np.ptp(after[1:]) > np.ptp(before[1:])


@pytest.mark.slow
def test_the_interval_of_forward_transfer_covers_what_it_promises():
    rng, covered, n = np.random.default_rng(0), 0, 1_500
    truth = forward_transfer(make_run(), make_run(RISING, (0, 0, 0))).value
    for _ in range(n):
        pair = make_run(), make_run(RISING, (0, 0, 0))
        for index, run in enumerate(pair):
            levels = 0.05 * rng.normal(size=(6, 1, 3))
            noisy = run.curves.success[:1] + levels + 0.05 * rng.normal(size=(6, 6, 3))
            curves = replace(run.curves, seeds=tuple(range(6)), success=noisy)
            pair = (*pair[:index], replace(run, curves=curves), *pair[index + 1 :])
        found = forward_transfer(*pair)
        covered += found.low <= truth <= found.high
    assert covered / n == pytest.approx(0.95, abs=0.02)


def test_forward_transfer_finds_the_task_in_another_order():
    by_task = np.tile([[0.1, 0.5, 0.9]], (6, 1))
    ordered, turned = make_run(by_task, (0, 0, 0)), make_run(by_task[:, ::-1], (0, 0, 0), "cba")
    areas = [own_areas(make_run(), reference) for reference in (ordered, turned)]
    np.testing.assert_allclose(areas[0], areas[1])
    np.testing.assert_allclose(areas[0][1], [[0.5, 0.9]] * 2)
