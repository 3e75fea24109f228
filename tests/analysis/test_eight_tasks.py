"""The row of the benchmark against numbers worked out by hand."""

import numpy as np
import pytest

from bgpo_trl.algorithms import ALGORITHMS
from bgpo_trl.algorithms.bgpo import BGPO
from bgpo_trl.analysis import eight_tasks
from bgpo_trl.analysis.intervals import Statistics
from bgpo_trl.analysis.transfer import forward_transfer
from bgpo_trl.runs.cost import Cost, write_costs
from tests.analysis.runs import SUCCESS, make_run


def test_matrix_is_the_success_at_the_ends_of_the_phases():
    matrix = eight_tasks.success_matrix(make_run())
    by_hand = [[0.8, np.nan, np.nan], [0.7, 0.6, np.nan], [0.5, 0.9, 0.4]]
    np.testing.assert_allclose(matrix, [by_hand, by_hand])


def test_matrix_averages_the_last_fifth_of_a_phase():
    success = np.linspace(0, 1, 100)[:, None] * [1, 1]
    success[:50, 1] = np.nan
    run = make_run(success, (0, 250), "ab")  # 50 tests a phase: those of the last 50 episodes
    matrix = eight_tasks.success_matrix(run)[0]
    np.testing.assert_allclose(matrix[0, 0], success[40:50, 0].mean())
    np.testing.assert_allclose(matrix[1], success[90:].mean(0))


def test_tasks_that_do_not_start_one_after_the_other_have_no_matrix():
    with pytest.raises(ValueError, match=r"starts its tasks at \[0, 0, 10\]: name runs of tasks"):
        eight_tasks.success_matrix(make_run(starts=(0, 0, 10)))
    with pytest.raises(ValueError, match=r"of 2 episodes without a test .* evaluate more often"):
        eight_tasks.success_matrix(make_run(starts=(0, 6, 8)))


def test_row_of_the_benchmark_by_hand(tmp_path):
    write_costs(tmp_path / "cost.csv", {1: Cost(100, 1800, 2.4), 3: Cost(50, 3600, 7.6)})
    run = make_run(directory=tmp_path, nodes=[10, 11], groups=[3, 3])
    told = make_run([*SUCCESS[:-1], [0.4, 0.8, 0.3]], name="oracle")
    head, ours, other = eight_tasks.benchmark_table(
        {"eight-bgpo": run, "eight-oracle": told}, {}, Statistics()
    )
    cells = dict(zip(head, ours, strict=True))
    assert cells["performance"] == "60.0 [60, 60]"  # 0.5, 0.9 and 0.4
    # Task 1 has lost 0.3, task 2 has gained 0.3, task 3 is as it was.
    assert cells["forgetting"] == "0.0 [0, 0]"
    assert (cells["knows the label"], cells["nodes"], cells["groups"]) == ("no", "10.5", "3")
    assert (cells["hours"], cells["megabytes"], cells["forward transfer"]) == ("1.5", "8", "-")
    assert cells["BGPO's lead"] == "-"
    assert other[1:4] == ["yes", "50.0 [50, 50]", "+10.0 [+10, +10]"]
    assert other[-5:] == ["-"] * 5


def test_forgetting_counts_all_tasks_and_backward_transfer_all_but_the_last():
    success = [*SUCCESS[:-1], [0.2, 0.9, 0.4]]
    run = make_run(success)
    references = {"eight-concurrent-bgpo": make_run(np.full((6, 3), 0.5), (0, 0, 0))}
    head, row = eight_tasks.benchmark_table({"eight-bgpo": run}, references, Statistics())
    cells = dict(zip(head, row, strict=True))
    assert cells["forgetting"] == "10.0 [10, 10]"  # (0.6 - 0.3 + 0) / 3
    assert cells["backward transfer"] == "-15.0 [-15, -15]"
    transfer, _ = forward_transfer(run, references["eight-concurrent-bgpo"], Statistics())
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
