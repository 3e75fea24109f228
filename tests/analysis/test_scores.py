"""Scores of runs and forward transfer, against numbers worked out by hand."""

import numpy as np
import pytest

from bgpo_trl.analysis import scores
from bgpo_trl.analysis.comparison import read_run
from bgpo_trl.analysis.scores import expected_own_episodes, forward_transfer, own_areas
from tests.analysis.runs import NAN, STARTS, TASKS, make_run, write_run, write_training


def test_late_scores_average_the_last_tenth_of_training():
    success = np.zeros((40, 1))
    success[36:] = [[0.1], [0.2], [0.3], [0.6]]  # tests after 185, ..., 200 of 200 episodes
    run = make_run(success, (0,), "a")
    assert scores.late_window(run) == 20
    np.testing.assert_allclose(scores.late_scores(run), [[0.3], [0.3]])
    # A tenth of 30 episodes has no test but the last.
    np.testing.assert_allclose(scores.late_scores(make_run()), [[0.5, 0.9, 0.4]] * 2)


def test_late_scores_of_an_untested_seed_are_refused():
    run = make_run()
    run.curves.success[1, -1, 2] = NAN
    with pytest.raises(ValueError, match="no late test of seed 1"):
        scores.late_scores(run)
    run = make_run()
    run.config["seeds"].append(7)
    with pytest.raises(ValueError, match="no late test of seed 7"):
        scores.late_scores(run)


def test_area_scores_start_when_a_task_is_presented():
    # Task b: tests after 5, ..., 20 episodes of its presence, the curve rising from 0.
    b = (5 * 0.2 + 5 * 0.5 + 5 * 0.65 + 5 * 0.8) / 20
    c = (5 * 0.0 + 5 * 0.2) / 10
    np.testing.assert_allclose(scores.area_scores(make_run())[0, 1:], [b, c])


def test_the_success_matrix_by_hand():
    matrix = scores.success_matrix(make_run())
    by_hand = [[0.8, NAN, NAN], [0.7, 0.6, NAN], [0.5, 0.9, 0.4]]
    np.testing.assert_allclose(matrix, [by_hand, by_hand])


def test_the_success_matrix_averages_the_last_fifth_of_a_phase():
    success = np.linspace(0, 1, 100)[:, None] * [1, 1]
    success[:50, 1] = NAN
    run = make_run(success, (0, 250), "ab")  # 50 tests a phase: those of the last 50 episodes
    matrix = scores.success_matrix(run)[0]
    np.testing.assert_allclose(matrix[0, 0], success[40:50, 0].mean())
    np.testing.assert_allclose(matrix[1], success[90:].mean(0))


def test_the_success_matrix_needs_tasks_one_after_the_other():
    with pytest.raises(ValueError, match=r"starts its tasks at \[0, 0, 10\]: only for tasks one"):
        scores.success_matrix(make_run(starts=(0, 0, 10)))
    with pytest.raises(ValueError, match=r"of 2 episodes without a test .* more often"):
        scores.success_matrix(make_run(starts=(0, 6, 8)))


def test_best_scores_average_whole_windows_over_all_seeds():
    success = np.zeros((40, 1))
    success[8:12] = 1  # a tenth of 200 episodes is four tests
    assert scores.best_scores(make_run(success, (0,), "a")).tolist() == [1]
    success[10:12] = 0
    run = make_run(success, (0,), "a")
    assert scores.best_scores(run).tolist() == [0.5]
    run.curves.success[1] = 0
    assert scores.best_scores(run).tolist() == [0.25]
    success[:2] = 1  # half of a window is none
    assert scores.best_scores(make_run(success, (0,), "a")).tolist() == [0.5]
    np.testing.assert_allclose(scores.best_scores(make_run()), [0.8, 0.9, 0.4])


def test_own_episodes_by_task_and_seed(tmp_path):
    def learned(after):  # half of the last twenty after so many
        return [0] * (after - 10) + [1] * 10

    never = [0] * 30
    directory = write_run(tmp_path, "bgpo", 9, episodes=120)
    run = read_run(directory)
    assert scores.own_episodes(run) is None
    seeds = [[learned(20), learned(30), never], [learned(40), learned(40), learned(30)]]
    write_training(directory, [*seeds, [never, learned(20), [0] * 10 + [1] * 20]])
    inf = np.inf
    assert scores.own_episodes(run).tolist() == [[20, 30, inf], [40, 40, 30], [inf, 20, 20]]
    assert scores.own_episodes(run, 0.8)[2].tolist() == [inf, inf, 26]


def test_success_lengths_average_late_successes(tmp_path):
    path = write_run(tmp_path, "bgpo", [2, 4, 0]) / "eval.csv"
    # Tests 0 and 1 of seed 0 and 0 to 3 of seed 1 succeed, in 5, 6, ... steps.
    expected = (5 + 6 + 5 + 6 + 7 + 8) / 6
    lengths = scores.success_lengths(read_run(path.parent))
    assert lengths == pytest.approx(dict.fromkeys(TASKS, expected))
    rows = [line.rsplit(",", 1)[0] for line in path.read_text().splitlines()]
    path.write_text("\n".join(rows) + "\n")
    assert scores.success_lengths(read_run(path.parent)) == {}


def test_final_tests_by_seed_and_task(tmp_path):
    run = read_run(write_run(tmp_path, "bgpo", [5, 5], tasks=("b", "a"), starts=(0, 0)))
    assert scores.final_shares(run, "seen", "success") is None
    head = "seed,demonstrations,task,episodes,success,task_inference\n"
    cells = {(0, "a"): 0.1, (0, "b"): 0.2, (1, "a"): 0.3, (1, "b"): 0.4}
    rows = [f"{seed},seen,{task},20,{share},\n" for (seed, task), share in cells.items()]
    (run.directory / "final.csv").write_text(head + "".join(rows))
    assert scores.final_shares(run, "seen", "success").tolist() == [[0.2, 0.1], [0.4, 0.3]]
    assert scores.final_shares(run, "seen", "task_inference") is None
    with pytest.raises(ValueError, match="lacks tests with held-out demonstrations: remove it"):
        scores.final_shares(run, "held-out", "success")


def test_expected_own_episodes_by_hand():
    episodes = [5, 10, 20, 30]
    # Alone until 10, one of two until 20, then one of three.
    expected = {0: [5, 10, 15, 15 + 10 / 3], 1: [0, 0, 5, 5 + 10 / 3], 2: [0, 0, 0, 10 / 3]}
    for task, own in expected.items():
        np.testing.assert_allclose(expected_own_episodes(STARTS, task, episodes), own)
    from_the_start = expected_own_episodes((0, 0, 4), 1, episodes)
    np.testing.assert_allclose(from_the_start, [2 + 1 / 3, 4, 2 + 16 / 3, 2 + 26 / 3])


def test_expected_own_episodes_of_the_sequential_schedule():
    episodes = [5, 10, 20, 30]
    expected = {0: [5, 10, 10, 10], 1: [0, 0, 10, 10], 2: [0, 0, 0, 10]}
    for task, own in expected.items():
        found = expected_own_episodes(STARTS, task, episodes, practised=False)
        np.testing.assert_allclose(found, own)
    two = expected_own_episodes((0, 4, 4), 2, episodes, practised=False)
    np.testing.assert_allclose(two, [0.5, 3, 8, 13])


# The reference plays each task in every third episode, all alike: after 5/3, 10/3, 5, ... own
# episodes.
RISING = [[0.3] * 3, *[[0.6] * 3] * 5]


def test_areas_are_taken_over_the_own_episodes_of_a_phase():
    ours, theirs = own_areas(make_run(), make_run(RISING, (0, 0, 0), "cba"))
    # Task b: 0.4 after 2.5 own episodes, 0.6 after 5; task c: 0 after 5/3, 0.4 after 10/3.
    np.testing.assert_allclose(ours, [[0.5, 0.2]] * 2)
    # The reference is at 0.45 after 2.5 and at 0.6 after 5; at 0.3 after 5/3 and at 0.6 after 10/3.
    np.testing.assert_allclose(theirs, [[(0.45 + 0.6) / 2, 0.45]] * 2)


def test_forward_transfer_by_hand():
    gain = forward_transfer(make_run(), make_run(RISING, (0, 0, 0)))
    expected = ((0.5 - 0.525) / (1 - 0.525) + (0.2 - 0.45) / (1 - 0.45)) / 2
    assert gain == pytest.approx([expected] * 3)  # the seeds are equal
    assert forward_transfer(make_run(), make_run(np.ones((6, 3)), (0, 0, 0))) is None


@pytest.mark.parametrize("curve", [lambda own: 0 * own + 0.8, lambda own: np.minimum(own / 9, 1)])
def test_forward_transfer_is_zero_for_order_independent_learning(curve):
    episodes = 5 * np.arange(1, 25)

    def learner(starts):
        own = [expected_own_episodes(starts, task, episodes) for task in range(3)]
        success = [np.where(of_task > 0, curve(of_task), np.nan) for of_task in own]
        return make_run(np.stack(success, -1), starts)

    gain = forward_transfer(learner((0, 40, 80)), learner((0, 0, 0)))
    assert gain.value == pytest.approx(0, abs=0.01)


def test_seeds_of_run_and_reference_widen_the_interval():
    run, reference = make_run(), make_run(RISING, (0, 0, 0))
    for widened, less in ((run, 0.1), (reference, 0.2)):
        before = forward_transfer(run, reference)
        widened.curves.success[1] -= less
        after = forward_transfer(run, reference)
        assert np.ptp(after[1:]) > np.ptp(before[1:])
