"""Compact copies of runs."""

import gzip

import pytest

from bgpo_trl.runs.archive import archive_run
from tests.analysis.runs import write_run, write_training
from tests.helpers import contents


def test_an_archive_is_compressed_and_always_the_same(tmp_path):
    run = write_run(tmp_path, "bgpo", 9)
    write_training(run, [[[0] * 10 + [1] * 3] * 3] * 3, ("a", "b", "c"))
    for name in ("a", "b"):
        archive_run(run, tmp_path / name)
    archive_run(tmp_path / "a", tmp_path / "c")  # from the compact form
    files = [{p.name: p.read_bytes() for p in (tmp_path / n).iterdir()} for n in "abc"]
    assert files[0] == files[1] == files[2]
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
