"""Files that are replaced as a whole, and folders that one process at a time holds."""

import os
import select

import numpy as np
import pandas as pd
import pytest
import torch
from matplotlib.figure import Figure

from bgpo_trl.figures.frames import save_gif
from bgpo_trl.figures.gwr import write_nodes
from bgpo_trl.figures.style import save_figure
from bgpo_trl.files.checkpoint import load_checkpoint, save_checkpoint
from bgpo_trl.files.csv_file import CsvFile
from bgpo_trl.files.tensor_file import save_tensors
from bgpo_trl.files.writing import lock_directory, write_whole
from bgpo_trl.runs.cost import write_costs
from bgpo_trl.runs.provenance import write_table
from tests.helpers import largest_file


def test_a_failed_write_keeps_the_old_file(tmp_path):
    write_whole(tmp_path / "file", "old")
    with largest_file(1), pytest.raises(OSError, match="File too large"):
        write_whole(tmp_path / "file", "new")
    assert (tmp_path / "file").read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


WRITERS = {
    "text": lambda path: write_whole(path, "new"),
    "figure": lambda path: save_figure(Figure(), path),
    "gif": lambda path: save_gif(np.zeros((2, 32, 64, 3), np.uint8), path),
    "tensors": lambda path: save_tensors(path, {"a": torch.zeros(2)}, {}),
    "rows": lambda path: write_table(path, pd.DataFrame({"a": [1]})),
    "costs": lambda path: write_costs(path, {}),
    "nodes": lambda path: write_nodes(path, torch.zeros(2, 3), torch.zeros(2)),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_a_symbolic_link_is_replaced_and_not_written_through(tmp_path, kind):
    WRITERS[kind](tmp_path / "reference")
    (tmp_path / "private").write_text("private")
    for name in ("file", "file.tmp"):
        (tmp_path / "file").unlink(missing_ok=True)
        (tmp_path / name).symlink_to(tmp_path / "private")
        WRITERS[kind](tmp_path / "file")
        assert (tmp_path / "private").read_text() == "private"
        assert not (tmp_path / "file").is_symlink()
        assert (tmp_path / "file").read_bytes() == (tmp_path / "reference").read_bytes()


def test_a_checkpoint_is_not_written_through_a_symbolic_link(tmp_path):
    (tmp_path / "private").write_text("private")
    (tmp_path / "checkpoint").mkdir()
    (tmp_path / "checkpoint" / "checkpoint.tmp").symlink_to(tmp_path / "private")
    save_checkpoint(tmp_path / "checkpoint", {"episode": 1})
    assert (tmp_path / "private").read_text() == "private"
    assert load_checkpoint(tmp_path / "checkpoint") == {"episode": 1}


@pytest.mark.parametrize("exists", [True, False])
def test_rows_are_not_appended_through_a_symbolic_link(tmp_path, refused, exists):
    if exists:
        (tmp_path / "private").touch()
    (tmp_path / "eval.csv").symlink_to(tmp_path / "private")
    refused(lambda: CsvFile(tmp_path / "eval.csv", ["a"]), "symbolic links", "choose another")
    assert (tmp_path / "private").exists() == exists


def test_a_second_process_is_refused_until_the_first_is_killed(other_process, refused, tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    process = other_process(run)
    assert process.stdout.readline() == "has it\n"
    refused(lambda: lock_directory(run).__enter__(), f"{run} is in use", "let it finish, or stop")
    process.kill()
    process.wait()
    assert (run / "lock").exists()
    with lock_directory(run):
        pass
    assert not list(run.iterdir())


def test_a_process_waits_until_the_last_holder_releases_a_reentrant_lock(other_process, tmp_path):
    first = lock_directory(tmp_path)
    second = lock_directory(tmp_path / "." / ".." / tmp_path.name)
    first.__enter__(), second.__enter__()
    first.__exit__(None, None, None)
    assert (tmp_path / "lock").exists()
    process = other_process(tmp_path, wait=True)
    assert process.stdout.readline() == "waits\n"
    assert not select.select([process.stdout], [], [], 0.5)[0]
    second.__exit__(None, None, None)
    assert process.stdout.readline() == "has it\n"


def test_a_forked_process_does_not_hold_the_lock(tmp_path):
    with lock_directory(tmp_path):
        child = os.fork()
        if not child:
            code = 1
            try:
                with lock_directory(tmp_path):
                    pass
            except BlockingIOError:
                code = 0
            finally:
                os._exit(code)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
        assert (tmp_path / "lock").exists()


def test_folders_made_for_the_lock_are_removed_while_empty(tmp_path):
    with lock_directory(tmp_path / "a" / "b"):
        pass
    assert not list(tmp_path.iterdir())
    with lock_directory(tmp_path / "a" / "b"):
        (tmp_path / "a" / "kept").touch()
    assert [path.name for path in tmp_path.rglob("*")] == ["a", "kept"]


def test_a_directory_that_cannot_be_locked_is_refused(tmp_path, refused):
    (tmp_path / "file").touch()
    (tmp_path / "run" / "lock").mkdir(parents=True)
    for name in ("file", "run"):
        refused(lambda name=name: lock_directory(tmp_path / name).__enter__(), "cannot", "choose")
