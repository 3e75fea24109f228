"""Curves read back from CSV files, against tables written by hand."""

import numpy as np
import pytest

from bgpo_trl.runs.results import read_curves, read_outcomes, read_rows

HEAD = "algorithm,seed,episode,env_steps,task,success,return,steps\n"


def write(path, rows):
    lines = [f"bgpo,{seed},{episode},9,{task},{s},{s}.0,5" for seed, episode, task, s in rows]
    path.write_text(HEAD + "".join(line + "\n" for line in lines))
    return path


def test_success_by_seed_evaluation_and_task(tmp_path):
    rows = [(7, 20, "b", 1), (7, 20, "b", 0), (7, 20, "a", 0), (7, 10, "a", 1)]
    rows += [(2, 10, "a", 0), (2, 20, "a", 1), (2, 20, "b", 1), (2, 20, "b", 1)]
    curves = read_curves(write(tmp_path / "eval.csv", rows), ["a", "b"])
    assert (curves.seeds, curves.tasks) == ((2, 7), ("a", "b"))
    assert curves.episodes.tolist() == [10, 20]
    # Task b was not tested after 10 episodes, which is not the same as never done.
    expected = [[[0, np.nan], [1, 1]], [[1, np.nan], [0, 0.5]]]
    np.testing.assert_array_equal(curves.success, expected)

    cut = curves.until(19)
    assert cut.episodes.tolist() == [10]
    np.testing.assert_array_equal(cut.success, np.array(expected)[:, :1])


def test_the_order_of_tasks_is_the_one_asked_for(tmp_path):
    path = write(tmp_path / "eval.csv", [(0, 10, "a", 1), (0, 10, "b", 0)])
    assert read_curves(path, ["b", "a"]).success.tolist() == [[[0, 1]]]


def test_what_is_no_record_of_these_tasks_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"eval.csv is missing: let the run"):
        read_rows(tmp_path / "eval.csv")
    with pytest.raises(ValueError, match="holds no test episode"):
        read_curves(write(tmp_path / "eval.csv", []), ["a"])
    with pytest.raises(ValueError, match="tests 'b', which is none of a"):
        read_curves(write(tmp_path / "eval.csv", [(0, 10, "b", 1)]), ["a"])


def test_outcomes_of_each_tasks_own_training_episodes(tmp_path):
    rows = [(7, 1, "a", 0), (2, 1, "a", 1), (2, 3, "b", 0), (2, 2, "b", 1), (7, 2, "a", 1)]
    path = write(tmp_path / "train.csv", rows)
    assert read_outcomes(path, ["a", "b"]) == [[[1], [1, 0]], [[0, 1], []]]
    assert read_outcomes(path, ["b"], last=2) == [[[1]], [[]]]
    path.write_text(path.read_text().replace("bgpo,2,3", "bgpo,2,x"))
    with pytest.raises(ValueError, match=r"train.csv, line 4 is damaged"):
        read_outcomes(path, ["a", "b"])
