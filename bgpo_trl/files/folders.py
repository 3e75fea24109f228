"""Folders that files go to, made on demand."""

from __future__ import annotations

import os
from pathlib import Path


def make_folder(path: str | os.PathLike[str]) -> Path:
    """Makes a folder, and those above it, unless it is there.

    Raises:
        OSError: If it cannot be made, such as where there is a file of that name.
    """
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OSError(f"cannot make the folder {path} ({error.strerror}): choose another") from None
    return path
