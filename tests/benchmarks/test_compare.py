"""Two runs are compared seed by seed, against numbers worked out by hand."""

import numpy as np
import pytest

from benchmarks import compare


def write(path, rows):
    path.mkdir()
    lines = ["algorithm,seed,episode,task,success"]
    lines += [",".join(map(str, ("bgpo", *row))) for row in rows]
    (path / "eval.csv").write_text("\n".join(lines) + "\n")
    return path


def test_p_is_the_share_of_deals_as_far_apart():
    # Of the 6 ways to deal 0, 0, 1, 1 into pairs, 2 are as far apart as (0, 0) and (1, 1).
    assert compare.permutation_p(np.array([0.0, 0]), np.array([1.0, 1])) == pytest.approx(2 / 6)
    assert compare.permutation_p(np.array([0.0, 1]), np.array([1.0, 0])) == 1
    five = compare.permutation_p(np.zeros(5), np.ones(5))
    assert five == pytest.approx(2 / 252)


def test_success_is_averaged_within_a_seed_first(tmp_path):
    rows = [(0, 10, "grasp", 1), (0, 20, "grasp", 0), (1, 20, "grasp", 1), (1, 21, "grasp", 0)]
    found = compare.success_by_seed(write(tmp_path / "a", rows) / "eval.csv", every=20)
    assert found["grasp", 20].tolist() == [0.5, 1.0]
    assert found["grasp", 40].tolist() == [0.0]


def test_the_table_has_what_both_runs_have(tmp_path, capsys):
    # The second run was cut short after episode 5: what comes later in the first does not count.
    first = write(
        tmp_path / "a",
        [(0, 5, "grasp", 0), (1, 5, "grasp", 0), (0, 5, "push", 1), (0, 9, "grasp", 1)],
    )
    second = write(tmp_path / "b", [(0, 5, "grasp", 1), (1, 5, "grasp", 1)])
    compare.main(compare.Arguments(first, second, every=10))
    assert capsys.readouterr().out.splitlines()[2:] == [
        "| grasp | 10 | 0.00 | 1.00 | +1.00 | 0.33 |"
    ]
    with pytest.raises(ValueError, match="share no task and part of training"):
        compare.main(compare.Arguments(first, write(tmp_path / "c", [(0, 5, "pull", 1)])))
