"""Folders, made on demand."""

from __future__ import annotations

import os
from pathlib import Path


def make_folder(path: str | os.PathLike[str]) -> Path:
    """Make a folder and its parents unless they exist.

    Raises:
        OSError: If it cannot be made, for example because a file has that name.
    """
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OSError(f"cannot make the folder {path} ({error.strerror}): choose another") from None
    return path
