"""Results read back from CSV files, against tables written by hand; compact copies."""

import gzip
import json

import numpy as np
import pandas as pd
import pytest

from bgpo_trl.runs.results import COLUMNS, archive_run, read_run, read_table
from tests.analysis.runs import write_run, write_training
from tests.helpers import contents, edit

NAN = np.nan
HEAD = "algorithm,seed,episode,env_steps,task,success,return,steps\n"


def write(path, rows):
    lines = [f"bgpo,{seed},{episode},9,{task},{s},{s}.0,5" for seed, episode, task, s in rows]
    path.write_text(HEAD + "".join(line + "\n" for line in lines))
    return path


def test_success_is_read_by_seed_evaluation_and_task(tmp_path):
    rows = [(7, 20, "b", 1), (7, 20, "b", 0), (7, 20, "a", 0), (7, 10, "a", 1)]
    rows += [(2, 10, "a", 0), (2, 20, "a", 1), (2, 20, "b", 1), (2, 20, "b", 1)]
    write(tmp_path / "eval.csv", rows)
    config = {"seeds": [2, 7], "tasks": ["a", "b"], "task_starts": [0, 10], "episodes": 20}
    (tmp_path / "config.json").write_text(json.dumps(config))
    run = read_run(tmp_path)
    assert run.episodes.tolist() == [10, 20]
    # Task b was not tested after 10 episodes, which is not a success of 0.
    expected = [[[0, NAN], [1, 1]], [[1, NAN], [0, 0.5]]]
    np.testing.assert_array_equal(run.success, expected)
    np.testing.assert_array_equal(run.until(10).success, np.array(expected)[:, :1])


def test_tables_of_other_seeds_or_tasks_are_refused(tmp_path):
    run = write_run(tmp_path, "bgpo", 9)
    for column, entry, other in (("seed", "seeds", [0, 1]), ("task", "tasks", ["a", "b", "c"])):
        edit(run / "config.json", **{entry: other})
        with pytest.raises(
            ValueError, match=rf"eval\.csv has the {column} .* none of {other[0]}, "
        ):
            read_run(run)
        edit(run / "config.json", seeds=[0, 1, 2])


def test_a_compressed_table_is_read_in_place_of_a_missing_one(tmp_path):
    rows = [(0, 10, "a", 1), (0, 20, "a", 0), (1, 10, "b", 1)]
    path = write(tmp_path / "eval.csv", rows)
    plain = read_table(path)
    content = path.read_bytes()
    path.with_name("eval.csv.gz").write_bytes(gzip.compress(content))
    path.unlink()
    pd.testing.assert_frame_equal(read_table(path), plain)
    path.with_name("eval.csv.gz").write_bytes(gzip.compress(content)[:-12])
    with pytest.raises(ValueError, match=r"eval\.csv\.gz is not a CSV file of a run"):
        read_table(path)


@pytest.mark.parametrize(
    ("column", "valid", "wrong"),
    [
        ("steps", ["0", "12"], ["1.5", "-1", "9007199254740992", ""]),  # counts
        ("seconds", ["1e3", "0.5"], ["inf", "nan", "", "ten"]),
    ],
)
def test_an_invalid_cell_is_reported_with_its_line(tmp_path, column, valid, wrong):
    path = tmp_path / "cost.csv"
    others = [name for name in COLUMNS["cost.csv"] if name != column]
    text = ",".join([*others, column]) + "\n" + "".join(f"1,1,1,{cell}\n" for cell in valid)
    path.write_text(text)
    assert read_table(path)[column].tolist() == [float(cell) for cell in valid]
    for cell in wrong:
        path.write_text(f"{text}1,1,1,{cell}\n1,1,1,{cell}\n")
        with pytest.raises(ValueError, match=rf"cost\.csv, line {2 + len(valid)} is damaged"):
            read_table(path)


def test_steps_may_be_empty_or_missing_but_not_damaged(tmp_path):
    head, row = "seed,demonstrations,task,success,task_inference", "0,seen,a,0.5,"
    path = tmp_path / "final.csv"
    for more, cell, steps in (("", "", NAN), (",steps", ",", NAN), (",steps", ",12.5", 12.5)):
        path.write_text(f"{head}{more}\n{row}{cell}\n")
        np.testing.assert_array_equal(read_table(path)["steps"], [steps])
    path.write_text(f"{head},steps\n{row},-3\n")
    with pytest.raises(ValueError, match="line 2 is damaged: remove the file and resume"):
        read_table(path)


def test_a_line_with_too_many_cells_is_refused(tmp_path):
    for rows in ("1,2\n1,2,3\n", "1,2,3\n1,2,3\n"):
        (tmp_path / "x.csv").write_text("a,b\n" + rows)
        with pytest.raises(ValueError, match=r"x\.csv is not a CSV file of a run"):
            read_table(tmp_path / "x.csv")


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


def test_an_archive_is_not_written_over_another_run(tmp_path):
    run, other = (write_run(tmp_path, name, 9) for name in ("bgpo", "oracle"))
    before = contents(tmp_path)
    with pytest.raises(ValueError, match="is the run itself: name another folder"):
        archive_run(run, run)
    with pytest.raises(ValueError, match="holds another run: name another folder"):
        archive_run(run, other)
    assert contents(tmp_path) == before
