"""Lock on a directory, so that only one process at a time writes to it."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from bgpo_trl.files.writing import make_folder


@contextlib.contextmanager
def lock_directory(directory: str | os.PathLike[str], *, wait: bool = False) -> Iterator[None]:
    """Hold an exclusive lock on a directory during a ``with`` block.

    The kernel frees the lock of a process that is killed. The lock is reentrant within a process (a
    `Trainer` takes it again within a job of a sweep). While it is held, there is a file ``lock`` in
    the directory.

    Args:
        directory: The directory, made if missing; what was made is removed if it stays empty.
        wait: Whether to wait for another process instead of raising.

    Raises:
        BlockingIOError: If another process holds the lock.
        OSError: If the directory cannot be made, written or locked.

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
    # One instance per path and process, which counts how often it is held.
    lock = FileLock(absolute / "lock", thread_local=False, is_singleton=True)
    while True:
        make_folder(directory)
        try:
            lock.acquire(timeout=-1 if wait else 0, poll_interval=0.5)
            break
        except FileNotFoundError:  # The last holder has just removed the folder.
            continue
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
