"""One process at a time in a directory: other processes are real ones."""

import os
import signal
import socket

import pytest

from bgpo_trl.files.locking import DirectoryLock


def refusal(directory):
    with pytest.raises(BlockingIOError) as raised:
        DirectoryLock(directory)
    return str(raised.value)


def test_the_second_process_is_told_of_the_first_one(other_process, tmp_path):
    run = tmp_path / "run"
    process = other_process(run)
    assert process.stdout.readline() == "has it\n"
    told = f"process {process.pid} on {socket.gethostname()}"
    assert refusal(run) == f"{run} is in use by {told}: let it finish, or stop it"
    assert (run / "lock").read_text() == f"{told}\n"
    process.communicate("\n")
    with DirectoryLock(run):
        pass


def test_a_process_that_is_killed_holds_nothing(other_process, tmp_path):
    process = other_process(tmp_path)
    assert process.stdout.readline() == "has it\n"
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert (tmp_path / "lock").exists()
    with DirectoryLock(tmp_path):
        assert (tmp_path / "lock").read_text().startswith(f"process {os.getpid()} on")
    assert not list(tmp_path.iterdir())


def test_whoever_waits_has_it_next(other_process, tmp_path):
    with DirectoryLock(tmp_path):
        process = other_process(tmp_path, wait=True)
        assert process.stdout.readline() == "waits\n"
    assert "has it\n" in process.stdout


def test_who_holds_it_may_take_it_again(other_process, tmp_path):
    """It is free when the last one is released, in whatever order."""
    first = DirectoryLock(tmp_path)
    second = DirectoryLock(tmp_path / "." / ".." / tmp_path.name)
    first.close()
    first.close()
    process = other_process(tmp_path, wait=True)
    assert process.stdout.readline() == "waits\n"
    second.close()
    assert "has it\n" in process.stdout


def test_a_fork_does_not_hold_it(tmp_path):
    with DirectoryLock(tmp_path):
        child = os.fork()
        if not child:
            code = 1
            try:
                DirectoryLock(tmp_path)
            except BlockingIOError as error:
                code = 0 if f"process {os.getppid()} on" in str(error) else 2
            finally:
                os._exit(code)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
        assert (tmp_path / "lock").exists()


def test_what_is_forgotten_is_released(tmp_path):
    DirectoryLock(tmp_path)
    assert not list(tmp_path.iterdir())


def test_nothing_is_left_of_a_lock(tmp_path):
    """Not even folders that it made, unless there is something in them now."""
    with DirectoryLock(tmp_path / "a" / "b"):
        pass
    assert not list(tmp_path.iterdir())
    with DirectoryLock(tmp_path / "a" / "b"):
        (tmp_path / "a" / "kept").touch()
    assert [path.name for path in tmp_path.rglob("*")] == ["a", "kept"]


def test_a_directory_that_cannot_be_locked_is_told(tmp_path, refused):
    (tmp_path / "file").touch()
    (tmp_path / "run" / "lock").mkdir(parents=True)
    refused(lambda: DirectoryLock(tmp_path / "file"), "cannot make the folder", "choose another")
    refused(lambda: DirectoryLock(tmp_path / "run"), "Is a directory", "choose another run")


def test_what_a_stranger_wrote_into_the_file_is_not_told(tmp_path, other_process):
    process = other_process(tmp_path)
    assert process.stdout.readline() == "has it\n"
    (tmp_path / "lock").write_bytes(b"\x1b[31mred\n")
    assert "in use by another process: " in refusal(tmp_path)
