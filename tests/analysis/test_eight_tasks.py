"""The row of the benchmark against numbers worked out by hand."""

from pathlib import Path

import numpy as np
import pytest

from bgpo_trl.algorithms import ALGORITHMS
from bgpo_trl.algorithms.bgpo import BGPO
from bgpo_trl.analysis import eight_tasks
from bgpo_trl.analysis.comparison import Run, Statistics
from bgpo_trl.runs.cost import Cost, write_costs
from bgpo_trl.runs.results import Curves

NAN = np.nan
STARTS = (0, 10, 20)
# Tests after 5, 10, ..., 30 episodes of tasks a, b and c, which start at 0, 10 and 20.
SUCCESS = [
    [0.2, NAN, NAN],
    [0.8, NAN, NAN],
    [0.6, 0.4, NAN],
    [0.7, 0.6, NAN],
    [0.5, 0.7, 0.0],
    [0.5, 0.9, 0.4],
]


def make_run(success=SUCCESS, starts=STARTS, tasks="abc", name="bgpo", directory="x", **summary):
    """Two equal seeds."""
    episodes = 5 * np.arange(1, len(success) + 1)
    config = {"name": name, "task_starts": list(starts), "tasks": list(tasks), "eval_every": 5}
    curves = Curves((0, 1), tuple(tasks), episodes, np.array([success, success]))
    return Run(Path(directory), "BGPO", config, summary, curves)


def test_matrix_is_the_success_at_the_ends_of_the_phases():
    matrix = eight_tasks.success_matrix(make_run())
    by_hand = [[0.8, NAN, NAN], [0.7, 0.6, NAN], [0.5, 0.9, 0.4]]
    np.testing.assert_allclose(matrix, [by_hand, by_hand])


def test_matrix_averages_the_last_fifth_of_a_phase():
    success = np.linspace(0, 1, 100)[:, None] * [1, 1]
    success[:50, 1] = NAN
    run = make_run(success, (0, 250), "ab")  # 50 tests a phase: those of the last 50 episodes
    matrix = eight_tasks.success_matrix(run)[0]
    np.testing.assert_allclose(matrix[0, 0], success[40:50, 0].mean())
    np.testing.assert_allclose(matrix[1], success[90:].mean(0))


def test_tasks_that_do_not_start_one_after_the_other_have_no_matrix():
    with pytest.raises(ValueError, match=r"starts its tasks at \[0, 0, 10\]: name runs of tasks"):
        eight_tasks.success_matrix(make_run(starts=(0, 0, 10)))
    with pytest.raises(ValueError, match=r"of 2 episodes without a test .* evaluate more often"):
        eight_tasks.success_matrix(make_run(starts=(0, 6, 8)))


def test_own_episodes_are_shared_among_the_presented_tasks():
    episodes = [5, 10, 20, 30]
    # Alone until 10, one of two until 20, then one of three.
    expected = {0: [5, 10, 15, 15 + 10 / 3], 1: [0, 0, 5, 5 + 10 / 3], 2: [0, 0, 0, 10 / 3]}
    for task, own in expected.items():
        np.testing.assert_allclose(eight_tasks.own_episodes(STARTS, task, episodes), own)
    from_the_start = eight_tasks.own_episodes((0, 0, 4), 1, episodes)
    np.testing.assert_allclose(from_the_start, [2 + 1 / 3, 4, 2 + 16 / 3, 2 + 26 / 3])


def test_forward_transfer_compares_equally_many_own_episodes():
    # Task b: 0.4 after 2.5 own episodes, 0.6 after 5; task c: 0 after 5/3, 0.4 after 10/3.
    b = (0.2 * 2.5 + 0.5 * 2.5) / 5
    c = 0.2 / 2
    # The reference plays each task in every third episode, all alike: 0.3 after 5/3, 0.6 after
    # 10/3, 0.6 for good. At 5 own episodes it has played 15.
    reference = make_run([[0.3] * 3, *[[0.6] * 3] * 5], (0, 0, 0), "cba")
    of_b = (0.15 * 5 / 3 + 0.45 * 5 / 3 + 0.6 * 5 / 3) / 5
    of_c = (0.15 + 0.45) / 2
    expected = [(b - of_b) / (1 - of_b), (c - of_c) / (1 - of_c)]
    np.testing.assert_allclose(eight_tasks.forward_transfer(make_run(), reference), [expected] * 2)


def test_forward_transfer_finds_the_task_in_another_order():
    by_task = np.tile([[0.1, 0.5, 0.9]], (6, 1))
    ordered, turned = make_run(by_task, (0, 0, 0)), make_run(by_task[:, ::-1], (0, 0, 0), "cba")
    gains = [eight_tasks.forward_transfer(make_run(), reference) for reference in (ordered, turned)]
    np.testing.assert_allclose(gains[0], gains[1])


def test_row_of_the_benchmark_by_hand(tmp_path):
    write_costs(tmp_path / "cost.csv", {1: Cost(100, 1800, 2.4), 3: Cost(50, 3600, 7.6)})
    run = make_run(directory=tmp_path, nodes=[10, 11], groups=[3, 3])
    told = make_run(name="oracle")
    head, ours, other = eight_tasks.benchmark_table(
        {"eight-bgpo": run, "eight-oracle": told}, {}, Statistics()
    )
    cells = dict(zip(head, ours, strict=True))
    assert cells["performance"] == "60.0 [60, 60]"  # 0.5, 0.9 and 0.4
    # Task 1 has lost 0.3, task 2 has gained 0.3, task 3 is as it was.
    assert cells["forgetting"] == "0.0 [0, 0]"
    assert (cells["knows the label"], cells["nodes"], cells["groups"]) == ("no", "10.5", "3")
    assert (cells["hours"], cells["megabytes"], cells["forward transfer"]) == ("1.5", "8", "-")
    assert other[1] == "yes"
    assert other[-5:] == ["-"] * 5


def test_forgetting_counts_all_tasks_and_backward_transfer_all_but_the_last():
    success = [*SUCCESS[:-1], [0.2, 0.9, 0.4]]
    run = make_run(success)
    references = {"eight-concurrent-bgpo": make_run(np.full((6, 3), 0.5), (0, 0, 0))}
    head, row = eight_tasks.benchmark_table({"eight-bgpo": run}, references, Statistics())
    cells = dict(zip(head, row, strict=True))
    assert cells["forgetting"] == "10.0 [10, 10]"  # (0.6 - 0.3 + 0) / 3
    assert cells["backward transfer"] == "-15.0 [-15, -15]"
    transfer = eight_tasks.forward_transfer(run, references["eight-concurrent-bgpo"]).mean()
    assert cells["forward transfer"].startswith(f"{100 * transfer:.1f} [")


def test_intervals_hold_what_seeds_differ_in():
    run = make_run()
    run.curves.success[1] = np.array(SUCCESS) / 2
    _, row = eight_tasks.benchmark_table({"eight-bgpo": run}, {}, Statistics())
    # 60 and 30 by seed. Each task draws twice: all from the second seed in 1 of 64 cases, all but
    # one of task c's, 33.3, in 2 of 64: the quantile of 2.5 %.
    assert row[2] == "45.0 [33, 57]"


def test_cost_of_a_step_by_the_number_of_tasks(tmp_path):
    assert eight_tasks.cost_table({"eight-bgpo": make_run(directory=tmp_path)}) == []
    write_costs(tmp_path / "cost.csv", {1: Cost(100, 0.5, 2.4), 2: Cost(50, 0.5, 7.6)})
    table = eight_tasks.cost_table({"eight-bgpo": make_run(directory=tmp_path)})
    assert table == [["", "1 task", "2 tasks"], ["BGPO", "5.0 ms, 2 MB", "10.0 ms, 8 MB"]]


def test_who_knows_the_label():
    for name, entry in ALGORITHMS.items():
        told = entry.make is not BGPO or entry.config == ALGORITHMS["oracle"].config
        assert eight_tasks.knows_label(make_run(name=name)) == told
