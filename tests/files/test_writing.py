"""Files that are replaced as a whole, and folders that one process at a time holds."""

import os
import select

import pytest

from bgpo_trl.files.writing import lock_directory, write_whole
from tests.helpers import largest_file


def test_a_failed_write_keeps_the_old_file(tmp_path):
    write_whole(tmp_path / "file", "old")
    with largest_file(1), pytest.raises(OSError, match="File too large"):
        write_whole(tmp_path / "file", "new")
    assert (tmp_path / "file").read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


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
        (tmp_path / "a" / "kept").touch()
    assert [path.name for path in tmp_path.rglob("*")] == ["a", "kept"]


def test_a_directory_that_cannot_be_locked_is_refused(tmp_path, refused):
    (tmp_path / "file").touch()
    (tmp_path / "run" / "lock").mkdir(parents=True)
    for name in ("file", "run"):
        refused(lambda name=name: lock_directory(tmp_path / name).__enter__(), "cannot", "choose")
