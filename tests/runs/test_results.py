"""Curves read back from CSV files, against tables written by hand."""

import gzip

import numpy as np
import pandas as pd
import pytest

from bgpo_trl.runs.results import (
    AMOUNT,
    COUNT,
    SHARE,
    read_curves,
    read_outcomes,
    read_table,
    read_tests,
)

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
        read_table(tmp_path / "eval.csv")
    with pytest.raises(ValueError, match="holds no test episode"):
        read_curves(write(tmp_path / "eval.csv", []), ["a"])
    with pytest.raises(ValueError, match="tests 'b', which is none of a"):
        read_curves(write(tmp_path / "eval.csv", [(0, 10, "b", 1)]), ["a"])


def outcomes(*arguments, **options):
    return [[task.tolist() for task in seed] for seed in read_outcomes(*arguments, **options)]


def test_outcomes_of_each_tasks_own_training_episodes(tmp_path):
    rows = [(7, 1, "a", 0), (2, 1, "a", 1), (2, 3, "b", 0), (2, 2, "b", 1), (7, 2, "a", 1)]
    path = write(tmp_path / "train.csv", rows)
    assert outcomes(path, ["a", "b"]) == [[[1], [1, 0]], [[0, 1], []]]
    assert outcomes(path, ["b"], last=2) == [[[1]], [[]]]
    path.write_text(path.read_text().replace("bgpo,2,3", "bgpo,2,x"))
    with pytest.raises(ValueError, match=r"train.csv, line 4 is damaged"):
        read_outcomes(path, ["a", "b"])


def test_a_compressed_table_is_read_where_the_plain_one_is_not_there(tmp_path):
    rows = [(0, 10, "a", 1), (0, 20, "a", 0), (1, 10, "b", 1)]
    path = write(tmp_path / "eval.csv", rows)
    plain = read_tests(path)
    content = path.read_bytes()
    path.with_name("eval.csv.gz").write_bytes(gzip.compress(content))
    path.unlink()
    pd.testing.assert_frame_equal(read_tests(path), plain)
    path.with_name("eval.csv.gz").write_bytes(gzip.compress(content)[:-12])
    with pytest.raises(ValueError, match=r"eval\.csv\.gz is not a CSV file of a run"):
        read_tests(path)


@pytest.mark.parametrize(
    ("kind", "cells", "line"),
    [
        (COUNT, ["0", "12", "1.5"], 4),
        (COUNT, ["-1", "3"], 2),
        (COUNT, ["9007199254740992"], 2),
        (SHARE, ["0", "1", "1.01"], 4),
        (SHARE, ["0.5", "nan"], 3),
        (SHARE, ["0.5", ""], 3),
        (AMOUNT, ["1e3", "inf"], 3),
        (("a", "b"), ["b", "c"], 3),
    ],
)
def test_the_first_invalid_cell_is_named_by_its_line(tmp_path, kind, cells, line):
    path = tmp_path / "x.csv"
    path.write_text("other,cell\n" + "".join(f"1,{cell}\n" for cell in cells))
    with pytest.raises(ValueError, match=rf"x\.csv, line {line} is damaged"):
        read_table(path, {"cell": kind})
    path.write_text("other,cell\n" + "".join(f"1,{cell}\n" for cell in cells[: line - 2]))
    assert len(read_table(path, {"cell": kind})) == line - 2


def test_a_line_of_too_many_cells_is_refused(tmp_path):
    for rows in ("1,2\n1,2,3\n", "1,2,3\n1,2,3\n"):
        (tmp_path / "x.csv").write_text("a,b\n" + rows)
        with pytest.raises(ValueError, match=r"x\.csv is not a CSV file of a run"):
            read_table(tmp_path / "x.csv")
