"""Folders made on demand, and files that are replaced as a whole, so that none is half-written."""

from __future__ import annotations

import contextlib
import json
import os
from pathlib import Path
from typing import Any


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


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file by way of a temporary one beside it; if it fails, the old one is kept.

    Raises:
        OSError: If it cannot be written.
    """
    temporary = path.with_name(f"{path.name}.tmp")
    try:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)
        temporary.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise


def write_json(path: Path, content: Any) -> None:
    """Write plain values as JSON; see `write_whole`."""
    write_whole(path, json.dumps(content, indent=2) + "\n")
