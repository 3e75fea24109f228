"""One process at a time in a directory: other processes are real ones."""

import os
import select
import signal

from bgpo_trl.files.writing import lock_directory


def test_a_second_process_is_refused_until_the_first_releases_the_lock(
    other_process, refused, tmp_path
):
    run = tmp_path / "run"
    process = other_process(run)
    assert process.stdout.readline() == "has it\n"
    refused(lambda: lock_directory(run).__enter__(), f"{run} is in use", "let it finish, or stop")
    process.communicate("\n")
    with lock_directory(run):
        pass


def test_a_killed_process_holds_no_lock(other_process, tmp_path):
    process = other_process(tmp_path)
    assert process.stdout.readline() == "has it\n"
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert (tmp_path / "lock").exists()
    with lock_directory(tmp_path):
        pass
    assert not list(tmp_path.iterdir())


def test_a_process_waits_until_the_last_holder_releases_a_reentrant_lock(other_process, tmp_path):
    first = lock_directory(tmp_path)
    second = lock_directory(tmp_path / "." / ".." / tmp_path.name)
    first.__enter__(), second.__enter__()
    first.__exit__(None, None, None)
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
