"""Lock on a directory, so that only one process at a time writes to it."""

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

from bgpo_trl.files.closing import Closing
from bgpo_trl.files.folders import make_folder

_OWNER = re.compile(r"process \d+ on \S+")
_SECONDS = 0.5  # polling interval of a waiting process


@dataclass
class _Held:
    descriptor: int
    made: list[Path]
    count: int = 1


# Keyed by process id, since a lock belongs to the process and a fork inherits none.
_held: dict[tuple[int, Path], _Held] = {}


class DirectoryLock(Closing):
    """Exclusive lock on a directory, held until it is closed or the process ends.

    The kernel frees the lock of a process that is killed. The lock is reentrant within a process (a
    `Trainer` takes it again within a job of a sweep): the last `close` frees it. While it is held,
    the file ``lock`` in the directory names process and machine.

    Args:
        directory: The directory, made if missing; removed on `close` if it is then empty.
        wait: Whether to wait for another process instead of raising.

    Raises:
        BlockingIOError: If another process holds the lock.
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

    def close(self) -> None:
        """Release the lock; repeated calls do nothing."""
        self._give_back()


def _take(directory: Path) -> _Held:
    path, absolute = directory / "lock", directory.resolve()
    made = [folder for folder in (absolute, *absolute.parents) if not folder.exists()]
    while True:
        make_folder(directory)
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        except FileNotFoundError:  # The last holder has just removed the folder.
            continue
        except OSError as error:
            raise OSError(
                f"cannot write {path} ({error.strerror}): choose another run directory"
            ) from None
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if _is_at(descriptor, path):
                owner = f"process {os.getpid()} on {socket.gethostname()}\n"
                with contextlib.suppress(OSError):  # The lock holds even if the disk is full.
                    os.ftruncate(descriptor, 0)
                    os.write(descriptor, owner.encode())
                return _Held(descriptor, made)
        except OSError as error:
            content = os.read(descriptor, 300).decode(errors="replace").strip()
            os.close(descriptor)
            if isinstance(error, BlockingIOError):
                owner = content if _OWNER.fullmatch(content) else "another process"
                raise BlockingIOError(
                    f"{directory} is in use by {owner}: let it finish, or stop it"
                ) from None
            raise OSError(
                f"cannot lock {directory} ({error.strerror}): choose one on another disk"
            ) from None
        os.close(descriptor)  # The last holder has just removed the file.


def _release(key: tuple[int, Path]) -> None:
    pid, directory = key
    if pid != os.getpid():
        return
    held = _held[key]
    held.count -= 1
    if held.count:
        return
    del _held[key]
    with contextlib.suppress(OSError):  # moved, not empty, or no longer writable
        # The file goes before the lock, so that a process waiting on it notices and makes another.
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
