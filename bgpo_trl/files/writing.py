"""Folders: made on demand, locked by a process; and files that are only replaced as a whole."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

_ABSOLUTE = re.compile(r"(?<![^\s'\"`=(])/[^\s'\"`,;:)]+")  # path, from the beginning of a word


def make_folder(path: str | os.PathLike[str]) -> Path:
    """Make a folder and its parents unless they exist."""
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OSError(f"cannot make the folder {path} ({error.strerror}): choose another") from None
    check_folder(path)
    return path


def check_folder(path: str | os.PathLike[str]) -> None:
    """Check that files can be written into a folder, before the work whose results they are.

    A folder that is missing is not made.

    Raises:
        OSError: If it, or the folder in which it would be made, is read-only or a file.
    """
    absolute = Path(path).absolute()
    there = next(place for place in (absolute, *absolute.parents) if place.exists())
    if not there.is_dir():
        raise NotADirectoryError(f"{there} is a file: choose another folder, such as by --out")
    if not os.access(there, os.W_OK):
        raise PermissionError(f"the folder {there} is read-only: choose another, such as by --out")


@contextlib.contextmanager
def new_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Make a folder to write in; it is removed again if that fails.

    Raises:
        ValueError: If something has its name.
        OSError: If it cannot be made.
    """
    path = Path(path)
    if os.path.lexists(path):
        raise ValueError(f"{path} exists: choose another folder, or remove it")
    make_folder(path.parent)
    try:
        path.mkdir()
    except FileExistsError:  # of another process, by now
        raise ValueError(f"{path} exists: choose another folder, or remove it") from None
    try:
        yield path
    except BaseException:
        shutil.rmtree(path)
        raise


def without_folders(text: str) -> str:
    """Return a text for others to read, with its absolute paths shortened.

    Of a path in the working directory, what follows that is left; of another one, the last name.

    Examples:
        >>> without_folders("python -m bgpo_trl report /scratch/me/runs --out=/tmp/report")
        'python -m bgpo_trl report .../runs --out=.../report'
    """
    return _ABSOLUTE.sub(lambda found: _shortened(Path(found[0])), text)


def _shortened(path: Path) -> str:
    here = Path.cwd()
    return str(path.relative_to(here)) if path.is_relative_to(here) else f".../{path.name}"


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file by way of a temporary one beside it; if it fails, the old one is kept.

    Raises:
        OSError: If it cannot be written.
    """
    temporary = path.with_name(f"{path.name}.tmp")
    try:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)
        temporary.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise OSError(
            error.errno, f"cannot write {path} ({error.strerror}): make room, or choose another"
        ) from error


def write_json(path: Path, content: Any) -> None:
    """Write plain values as JSON; see `write_whole`."""
    write_whole(path, json.dumps(content, indent=2) + "\n")


@contextlib.contextmanager
def lock_directory(directory: str | os.PathLike[str], *, wait: bool = False) -> Iterator[None]:
    """Hold an exclusive lock on a directory during a ``with`` block.

    The kernel frees the lock of a process that is killed. The lock is reentrant within a process (a
    `Trainer` takes it again within a job of a sweep). While it is held, there is a file ``lock`` in
    the directory.

    Args:
        directory: The directory, made if missing; what was made is removed if it stays empty.
        wait: Whether to wait for another process instead of raising.

    Examples:
        >>> import tempfile
        >>> run = Path(tempfile.mkdtemp()) / "run"
        >>> with lock_directory(run):
        ...     [path.name for path in run.iterdir()]
        ['lock']
        >>> run.exists()
        False
    """
    absolute = Path(directory).resolve()
    made = [folder for folder in (absolute, *absolute.parents) if not folder.exists()]
    make_folder(directory)
    # One instance per path and process, which counts how often it is held.
    lock = FileLock(absolute / "lock", thread_local=False, is_singleton=True)
    try:
        lock.acquire(timeout=-1 if wait else 0, poll_interval=0.5)
    except Timeout:
        raise BlockingIOError(
            f"{directory} is in use by another process: let it finish, or stop it"
        ) from None
    except OSError as error:
        raise OSError(
            f"cannot lock {directory} ({error.strerror}): choose another directory"
        ) from None
    try:
        yield
    finally:
        if lock.lock_counter == 1:
            # Before the release: waiting processes notice that the file is gone and make another.
            with contextlib.suppress(OSError):  # gone, or a folder that is not empty
                (absolute / "lock").unlink()
                for folder in made:
                    folder.rmdir()
        lock.release()
