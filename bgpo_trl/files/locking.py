"""A lock on a directory, so that one process at a time writes there."""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import socket
import time
import weakref
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from bgpo_trl.files.folders import make_folder

_OWNER = re.compile(r"process \d+ on \S+")
_SECONDS = 0.5  # between two looks at a lock that is waited for


@dataclass
class _Held:
    descriptor: int
    made: list[Path]
    count: int = 1


# The lock is the process's, whichever of its objects asked for it; a fork holds none.
_held: dict[tuple[int, Path], _Held] = {}


class DirectoryLock:
    """Keeps other processes off a directory until it is released, or this process ends.

    The kernel takes it back from a process that ends, however it does. What holds it may take it
    again, as a `Trainer` does within a job of a sweep: it is free when the last one is released.

    While it is held, the file ``lock`` in the directory names process and machine.

    Args:
        directory: Made if it does not exist; removed at the end if it is still empty then.
        wait: Wait for the other process instead of raising.

    Raises:
        BlockingIOError: If another process holds it.
        OSError: If the directory cannot be made, written or locked.

    Example:
        >>> import tempfile
        >>> run = Path(tempfile.mkdtemp()) / "run"
        >>> with DirectoryLock(run):
        ...     [path.name for path in run.iterdir()]
        ['lock']
        >>> run.exists()
        False
    """

    def __init__(self, directory: str | os.PathLike[str], *, wait: bool = False) -> None:
        directory = Path(directory)
        key = os.getpid(), directory.resolve()
        while True:
            try:
                if key in _held:
                    _held[key].count += 1
                else:
                    _held[key] = _take(directory)
                break
            except BlockingIOError:
                if not wait:
                    raise
            time.sleep(_SECONDS)
        self._give_back = weakref.finalize(self, _release, key)

    def release(self) -> None:
        """Gives it back; a second time, nothing happens."""
        self._give_back()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc_value: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.release()


def _take(directory: Path) -> _Held:
    path, absolute = directory / "lock", directory.resolve()
    made = [folder for folder in (absolute, *absolute.parents) if not folder.exists()]
    while True:
        make_folder(directory)
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        except FileNotFoundError:  # Its last holder has just removed the folder.
            continue
        except OSError as error:
            raise OSError(
                f"cannot write {path} ({error.strerror}): choose another run directory"
            ) from None
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if _is_at(descriptor, path):
                owner = f"process {os.getpid()} on {socket.gethostname()}\n"
                with contextlib.suppress(OSError):  # A full disk does not undo the lock.
                    os.ftruncate(descriptor, 0)
                    os.write(descriptor, owner.encode())
                return _Held(descriptor, made)
        except OSError as error:
            told = os.read(descriptor, 300).decode(errors="replace").strip()
            os.close(descriptor)
            if isinstance(error, BlockingIOError):
                owner = told if _OWNER.fullmatch(told) else "another process"
                raise BlockingIOError(
                    f"{directory} is in use by {owner}: let it finish, or stop it"
                ) from None
            raise OSError(
                f"cannot lock {directory} ({error.strerror}): choose one on another disk"
            ) from None
        os.close(descriptor)  # Its last holder has just removed the file.


def _release(key: tuple[int, Path]) -> None:
    pid, directory = key
    if pid != os.getpid():
        return
    held = _held[key]
    held.count -= 1
    if held.count:
        return
    del _held[key]
    with contextlib.suppress(OSError):  # moved, not empty, or not to be written any more
        # The file first: whoever opened it before finds that it is gone, and makes another.
        if _is_at(held.descriptor, directory / "lock"):
            (directory / "lock").unlink()
        for folder in held.made:
            folder.rmdir()
    os.close(held.descriptor)


def _is_at(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except OSError:
        return False
