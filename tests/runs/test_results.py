"""Results read back from CSV files, against tables written by hand; compact copies."""

import gzip
import json
from functools import partial
from itertools import product

import numpy as np
import pytest

from bgpo_trl.runs.results import COLUMNS, archive_run, read_run, read_table
from tests.analysis.runs import HEAD, write_run, write_training
from tests.helpers import edit

NAN = np.nan


def test_success_is_read_by_seed_evaluation_and_task(tmp_path):
    rows = [(7, 20, "b", 1), (7, 20, "b", 0), (7, 20, "a", 0), (7, 10, "a", 1)]
    rows += [(2, 10, "a", 0), (2, 20, "a", 1), (2, 20, "b", 1), (2, 20, "b", 1)]
    lines = [f"bgpo,{seed},{episode},9,{task},{s},{s}.0,5\n" for seed, episode, task, s in rows]
    (tmp_path / "eval.csv").write_text(HEAD + "".join(lines))
    config = {"seeds": [2, 7], "tasks": ["a", "b"], "task_starts": [0, 10], "episodes": 20}
    config |= {"name": "bgpo", "schedule": "practised", "eval_every": 10}
    (tmp_path / "config.json").write_text(json.dumps(config))
    run = read_run(tmp_path)
    assert run.episodes.tolist() == [10, 20]
    # Task b was not tested after 10 episodes, which is not a success of 0.
    expected = [[[0, NAN], [1, 1]], [[1, NAN], [0, 0.5]]]
    np.testing.assert_array_equal(run.success, expected)


@pytest.mark.parametrize(
    ("entry", "other", "cause"),
    [
        ("seeds", [0, 1], r"the seed 2, which is none of 0, 1: put"),
        ("tasks", ["a", "b", "c"], r"the task .* none of a, "),
        ("name", "mine", r"the algorithm 'bgpo', which is none of mine"),
        ("episodes", 39, r"tests after 40 episodes, the run 39: leave"),
    ],
)
def test_tables_that_do_not_fit_the_settings_are_refused(tmp_path, entry, other, cause):
    run = write_run(tmp_path, "bgpo", 9)
    edit(run / "config.json", **{entry: other})
    with pytest.raises(ValueError, match=r"eval\.csv has " + cause):
        read_run(run)


def test_a_compressed_table_that_is_damaged_is_refused(tmp_path):
    (tmp_path / "eval.csv.gz").write_bytes(gzip.compress(HEAD.encode())[:-12])
    with pytest.raises(ValueError, match=r"eval\.csv\.gz is damaged, or no table"):
        read_table(tmp_path / "eval.csv")


@pytest.mark.parametrize(
    ("name", "valid", "wrong"),
    [
        ("cost.csv", "1,2,1e3,0.5", ["1.5,2,1,1", "-1,2,1,1", "1,2,inf,1", "1,2,,1", "1,2,ten,1"]),
        ("cost.csv", "1,2,3,4", ["1,2", "1,2,3,4,5", "1\n1,2,3,4,5"]),
        (
            "final.csv",
            "0,seen,a,20,0.5,,",
            ["0,seen,a,20,1.5,,", "0,seen,a,20,,,", ",seen,a,2,1,,"],
        ),
        ("final.csv", "0,seen,NA,20,1,12.5,1", ["0,seen,a,20,1,-3,", "0,seen,a,20,1,3,2"]),
    ],
)
def test_an_invalid_cell_is_refused(tmp_path, name, valid, wrong):
    path, head = tmp_path / name, ",".join(COLUMNS[name])
    path.write_text(f"{head}\n{valid}\n{valid}\n")
    read = read_table(path)
    for column, cell in zip(COLUMNS[name], valid.split(","), strict=True):
        text = read[column].dtype == object or isinstance(read[column].iloc[0], str)
        expected = cell if text else float(cell or "nan")
        np.testing.assert_array_equal(read[column], [expected] * 2)
    # Of rows that are all longer than the head, pandas would drop the last cells.
    for first, row in product((valid, None), wrong):
        path.write_text(f"{head}\n{first or row}\n{row}\n")
        with pytest.raises(ValueError, match=rf"{name} is damaged, or no table of a run \("):
            read_table(path)


def test_what_only_some_runs_have_may_be_missing(tmp_path):
    path = tmp_path / "final.csv"
    path.write_text("seed,demonstrations,task,success\n0,seen,a,0.5\n")
    assert np.isnan(read_table(path)[["steps", "task_inference"]]).all(axis=None)
    path.write_text("seed,task,success\n0,a,0.5\n")
    with pytest.raises(ValueError, match="it lacks the columns demonstrations"):
        read_table(path)


def test_an_archive_is_compressed_and_always_the_same(tmp_path):
    run = write_run(tmp_path, "bgpo", 9)
    write_training(run, [[[0] * 10 + [1] * 3] * 3] * 3, ("a", "b", "c"))
    for name in ("a", "b"):
        archive_run(run, tmp_path / name)
    archive_run(tmp_path / "a", tmp_path / "c")  # from the compact form
    files = [{p.name: p.read_bytes() for p in (tmp_path / n).iterdir()} for n in "abc"]
    assert files[0] == files[1] == files[2]
    assert files[0]["eval.csv.gz"][4:8] == bytes(4)  # where gzip would keep the time
    assert {"config.json", "train.csv.gz", "eval.csv.gz"} <= files[0].keys()
    assert files[0]["config.json"] == (run / "config.json").read_bytes()
    heads = {n: gzip.decompress(files[0][n]).decode().split("\n")[0] for n in files[0] if "gz" in n}
    assert heads["train.csv.gz"] == "seed,episode,task,success,num_nodes,group,num_groups"
    assert heads["eval.csv.gz"] == "algorithm,seed,episode,task,success,steps"


def test_an_archive_is_not_written_over_another_run(tmp_path, refused):
    run, other = (write_run(tmp_path, name, 9) for name in ("bgpo", "oracle"))
    for target in (run, other):
        refused(partial(archive_run, run, target), "is the run, or holds another", "name another")
