"""Measures of arrays and of runs, against numbers worked out by hand."""

import math

import numpy as np
import pytest

from bgpo_trl.analysis import scores
from bgpo_trl.analysis.scores import expected_own_episodes, forward_transfer, own_areas
from bgpo_trl.runs.results import read_run
from tests.analysis.runs import NAN, STARTS, SUCCESS, make_run, write_run, write_training

INF = np.inf


def test_area_under_curve_by_hand():
    # Triangle to 10, then two trapezoids; the last interval is twice as long.
    area = (10 * 0.2 + 10 * (0.4 + 0.8) / 2 + 20 * (0.8 + 0.6) / 2) / 40
    several = scores.area_under_curve([[0.4, 0.8, 0.6], [1, 1, 1], [0, 0, 0]], [10, 20, 40])
    assert several.tolist() == pytest.approx([area, 1 - 10 * 0.5 / 40, 0])
    # Of a run, it starts when a task is presented. Task b: tests after 5, ..., 20 episodes of its
    # presence, the curve rising from 0.
    b = (5 * 0.2 + 5 * 0.5 + 5 * 0.65 + 5 * 0.8) / 20
    c = (5 * 0.0 + 5 * 0.2) / 10
    np.testing.assert_allclose(scores.area_scores(make_run())[0, 1:], [b, c])
    success = np.stack([SUCCESS] * 2)
    success[1, -2, 2] = NAN
    with pytest.raises(ValueError, match="has no test of seed 1 in c after 25 episodes"):
        scores.area_scores(make_run(success))


def test_late_scores_average_the_last_tenth_of_training():
    success = np.zeros((40, 1))
    success[36:] = [[0.1], [0.2], [0.3], [0.6]]  # tests after 185, ..., 200 of 200 episodes
    run = make_run(success, (0,), "a")
    assert scores.late_window(run) == 20
    np.testing.assert_allclose(scores.late_scores(run), [[0.3], [0.3]])
    # A tenth of 30 episodes has no test but the last.
    run = make_run()
    np.testing.assert_allclose(scores.late_scores(run), [[0.5, 0.9, 0.4]] * 2)
    run = make_run()
    run.config["seeds"].append(7)
    with pytest.raises(ValueError, match="no late test of seed 7"):
        scores.late_scores(run)
    success = np.stack([SUCCESS] * 2)
    success[1, -1, 2] = NAN
    with pytest.raises(ValueError, match="no late test of seed 1"):
        scores.late_scores(make_run(success))


def test_the_success_matrix_averages_the_last_fifth_of_a_phase():
    by_hand = [[0.8, NAN, NAN], [0.7, 0.6, NAN], [0.5, 0.9, 0.4]]
    np.testing.assert_allclose(scores.success_matrix(make_run()), [by_hand, by_hand])
    success = np.linspace(0, 1, 100)[:, None] * [1, 1]
    success[:50, 1] = NAN
    run = make_run(success, (0, 250), "ab")  # 50 tests a phase: those of the last 50 episodes
    matrix = scores.success_matrix(run)[0]
    np.testing.assert_allclose(matrix[0, 0], success[40:50, 0].mean())
    np.testing.assert_allclose(matrix[1], success[90:].mean(0))
    with pytest.raises(ValueError, match=r"starts its tasks at \[0, 0, 10\]: only for tasks one"):
        scores.success_matrix(make_run(starts=(0, 0, 10)))
    with pytest.raises(ValueError, match=r"no test .* more often"):
        scores.success_matrix(make_run(starts=(0, 6, 8)))


def test_own_episodes_by_task_and_seed(tmp_path):
    def learned(after):  # half of the last twenty after so many
        return [0] * (after - 10) + [1] * 10

    never, early = [0] * 30, [1] * 10 + [0] * 10  # of fewer than twenty there is no rate
    directory = write_run(tmp_path, "bgpo", 9, episodes=120)
    assert scores.own_episodes(read_run(directory)) is None
    seeds = [[learned(20), learned(30), never], [learned(40), [1] * 19, learned(30)]]
    write_training(directory, [*seeds, [[], early, [0] * 10 + [1] * 20]])
    run = read_run(directory)
    assert scores.own_episodes(run).tolist() == [[20, 30, INF], [40, INF, 30], [INF, 20, 20]]
    assert scores.own_episodes(run, 0.8)[2].tolist() == [INF, INF, 26]


def test_steps_of_late_successes_by_seed_and_task(tmp_path):
    path = write_run(tmp_path, "bgpo", [2, 4, 0]) / "eval.csv"
    # Tests 0 and 1 of seed 0 and 0 to 3 of seed 1 succeed, in 5, 6, ... steps.
    expected = [[(5 + 6) / 2] * 3, [(5 + 6 + 7 + 8) / 4] * 3, [NAN] * 3]
    np.testing.assert_allclose(scores.success_steps(read_run(path.parent)), expected)
    rows = [line.rsplit(",", 1)[0] for line in path.read_text().splitlines()]
    path.write_text("\n".join(rows) + "\n")
    assert np.isnan(scores.success_steps(read_run(path.parent))).all()
    run = make_run(tasks="abc", demonstrated_steps={"c": 3.0, "a": 1.0, "other": 9.0})
    np.testing.assert_array_equal(scores.demonstrated_steps(run), [1, NAN, 3])


def test_final_tests_by_seed_and_task(tmp_path):
    path = write_run(tmp_path, "bgpo", [5, 5], tasks=("b", "a"), starts=(0, 0))
    assert scores.final_means(read_run(path), "seen", "success") is None
    head = "seed,demonstrations,task,episodes,success,steps,task_inference\n"
    cells = {(0, "a"): 0.1, (0, "b"): 0.2, (1, "a"): 0.3, (1, "b"): 0.4}
    steps = {(0, "a"): "", (0, "b"): 12.5, (1, "a"): 9, (1, "b"): 8}
    rows = [f"{s},seen,{task},20,{share},{steps[s, task]},\n" for (s, task), share in cells.items()]
    (path / "final.csv").write_text(head + "".join(rows))
    run = read_run(path)
    assert scores.final_means(run, "seen", "success").tolist() == [[0.2, 0.1], [0.4, 0.3]]
    np.testing.assert_array_equal(scores.final_means(run, "seen", "steps"), [[12.5, NAN], [8, 9]])
    assert scores.final_means(run, "seen", "task_inference") is None
    with pytest.raises(ValueError, match="lacks tests with held-out demonstrations: remove it"):
        scores.final_means(run, "held-out", "success")


@pytest.mark.parametrize(
    ("starts", "task", "practised", "expected"),
    [
        # Alone until 10, one of two until 20, then one of three.
        (STARTS, 0, True, [5, 10, 15, 15 + 10 / 3]),
        (STARTS, 1, True, [0, 0, 5, 5 + 10 / 3]),
        (STARTS, 2, True, [0, 0, 0, 10 / 3]),
        ((0, 0, 4), 1, True, [2 + 1 / 3, 4, 2 + 16 / 3, 2 + 26 / 3]),
        (STARTS, 0, False, [5, 10, 10, 10]),
        (STARTS, 1, False, [0, 0, 10, 10]),
        ((0, 4, 4), 2, False, [0.5, 3, 8, 13]),
    ],
)
def test_expected_own_episodes_by_hand(starts, task, practised, expected):
    run = make_run(starts=starts, schedule="practised" if practised else "sequential")
    found = expected_own_episodes(run, task, [5, 10, 20, 30])
    np.testing.assert_allclose(found, expected)


# The reference plays each task in every third episode, all alike: after 5/3, 10/3, 5, ... own
# episodes.
RISING = [[0.3] * 3, *[[0.6] * 3] * 5]


def test_forward_transfer_compares_areas_over_the_own_episodes_of_a_phase():
    ours, theirs = own_areas(make_run(), make_run(RISING, (0, 0, 0), "cba"))
    # Task b: 0.4 after 2.5 own episodes, 0.6 after 5; task c: 0 after 5/3, 0.4 after 10/3.
    np.testing.assert_allclose(ours, [[0.5, 0.2]] * 2)
    # The reference is at 0.45 after 2.5 and at 0.6 after 5; at 0.3 after 5/3 and at 0.6 after 10/3.
    np.testing.assert_allclose(theirs, [[(0.45 + 0.6) / 2, 0.45]] * 2)
    gain = forward_transfer(make_run(), make_run(RISING, (0, 0, 0)))
    expected = ((0.5 - 0.525) / (1 - 0.525) + (0.2 - 0.45) / (1 - 0.45)) / 2
    assert gain == pytest.approx([expected, math.nan, math.nan], nan_ok=True)  # equal seeds
    assert forward_transfer(make_run(), make_run(np.ones((6, 3)), (0, 0, 0))) is None


def test_what_follows_a_phase_is_no_part_of_its_area():
    """Phases end between tests, and nothing is remembered."""
    success = [[1, NAN, NAN], [1, NAN, NAN], [0, 1, NAN], [0, 1, NAN], [0, 0, 1], [0, 0, 1]]
    run = make_run(success, (0, 12, 22), schedule="sequential")
    ours, theirs = own_areas(run, make_run(np.ones((6, 3)), (0, 0, 0), schedule="sequential"))
    assert ours.tolist() == theirs.tolist() == [[1, 1]] * 2
    short = make_run(success, (0, 11, 14), schedule="sequential")
    assert forward_transfer(short, make_run(RISING, (0, 0, 0), schedule="sequential")) is None


@pytest.mark.parametrize("curve", [lambda own: 0 * own + 0.8, lambda own: np.minimum(own / 9, 1)])
def test_forward_transfer_is_zero_for_order_independent_learning(curve):
    episodes = 5 * np.arange(1, 25)

    def learner(starts):
        planned = make_run(starts=starts)
        own = [expected_own_episodes(planned, task, episodes) for task in range(3)]
        success = [np.where(of_task > 0, curve(of_task), np.nan) for of_task in own]
        return make_run(np.stack(success, -1), starts)

    gain = forward_transfer(learner((0, 40, 80)), learner((0, 0, 0)))
    assert gain.value == pytest.approx(0, abs=0.01)


@pytest.mark.slow
def test_the_interval_of_forward_transfer_has_its_nominal_coverage():
    rng, covered, n = np.random.default_rng(0), 0, 1_500
    exact = make_run(), make_run(RISING, (0, 0, 0))
    truth = forward_transfer(*exact).value
    for _ in range(n):
        noisy = []
        for run in exact:
            levels = 0.05 * rng.normal(size=(6, 1, 3))
            success = run.success[:1] + levels + 0.05 * rng.normal(size=(6, 6, 3))
            noisy.append(make_run(success, run.starts))
        found = forward_transfer(*noisy)
        covered += found.low <= truth <= found.high
    assert covered / n == pytest.approx(0.95, abs=0.02)
