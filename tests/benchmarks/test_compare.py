"""Two runs are compared seed by seed, against numbers worked out by hand."""

import pytest

from benchmarks import compare
from bgpo_trl.analysis import statistics
from tests.analysis.runs import TASKS, edit, write_run


@pytest.fixture
def runs(tmp_path):
    """A run at 40, 50 and 40 %, and one of eight tenths of its length at 90, 80 and 100 %."""
    first = write_run(tmp_path, "oracle", [4, 5, 4], starts=(0, 14, 26))
    second = write_run(tmp_path, "bgpo", [9, 8, 10], starts=(0, 14, 26), episodes=32)
    return first, second


def table(capsys):
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def test_seeds_are_compared_on_what_both_runs_have(runs, capsys):
    compare.main(compare.Arguments(*runs))
    *tasks, mean = table(capsys)
    assert [row[1] for row in tasks] == list(TASKS)
    # At episode 32, the first run is at half of its level, rounded down: 20 % in each seed.
    by_hand = statistics.difference([0.9, 0.8, 1.0], [0.2, 0.2, 0.2])
    assert mean == [
        *("last 10 %", "all", "20.0", "90.0"),
        *(by_hand.estimate.points(), "0.100", by_hand.note),
    ]
    assert [row[2:] for row in tasks] == [mean[2:]] * 3


def test_parts_of_training_leave_out_tasks_that_were_not_presented(runs, capsys):
    compare.main(compare.Arguments(*runs, every=14))
    rows = table(capsys)
    assert [row[0] for row in rows] == ["to 14"] * 2 + ["to 28"] * 4 + ["last 10 %"] * 4
    # To 28, tests at 26 and 28 of the second run are in its last fifth, five before are not.
    halves = [(2 * late + 5 * half) / 7 for late, half in ((9, 4), (8, 4), (10, 5))]
    assert rows[2][2:4] == ["20.0", f"{10 * sum(halves) / 3:.1f}"]


def test_other_conditions_and_tasks_are_refused(runs, capsys, tmp_path):
    edit(runs[0] / "config.json", held_out="test")
    with pytest.raises(ValueError, match=r"differ in held_out \(test and validation\): only"):
        compare.main(compare.Arguments(*runs))
    compare.main(compare.Arguments(*runs, anyway=True))
    assert "differ in held_out (test and validation)" in capsys.readouterr().out
    other = write_run(tmp_path, "ddpg", 3, tasks=("pull",), starts=(0,))
    with pytest.raises(ValueError, match="only runs of the same tasks in the same order"):
        compare.main(compare.Arguments(runs[0], other, anyway=True))
