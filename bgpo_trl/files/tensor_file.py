"""Safetensors files with a checksum, so that damage is detected on reading."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path

from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor

from bgpo_trl.files.writing import make_folder, write_whole


def digest(tensors: Mapping[str, Tensor]) -> str:
    """Return the SHA-256 of the names and bytes of tensors."""
    sha256 = hashlib.sha256()
    for key in sorted(tensors):
        sha256.update(key.encode())
        sha256.update(tensors[key].cpu().contiguous().numpy().data)
    return sha256.hexdigest()


def _checksum(tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> str:
    content = json.dumps([digest(tensors), dict(metadata)], sort_keys=True)
    return hashlib.sha256(content.encode()).hexdigest()


def save_tensors(
    path: str | os.PathLike[str], tensors: Mapping[str, Tensor], metadata: Mapping[str, str]
) -> None:
    """Write tensors and their metadata; missing folders are made.

    Raises:
        OSError: If the file cannot be written; an existing file is kept.
    """
    path = Path(path)
    make_folder(path.parent)
    contiguous = {key: value.contiguous() for key, value in tensors.items()}
    write_whole(path, save(contiguous, {**metadata, "sha256": _checksum(contiguous, metadata)}))


def load_tensors(path: str | os.PathLike[str]) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Read the tensors and the metadata written by `save_tensors`.

    Raises:
        FileNotFoundError: If the file does not exist.
        ValueError: If it is damaged or has another format; the message gives only the reason.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(path)
    try:
        with safe_open(path, "pt") as file:
            metadata = dict(file.metadata() or {})
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        written = metadata.pop("sha256", None)
        found = _checksum(tensors, metadata)
    except Exception as error:  # safetensors raises many kinds of errors
        raise ValueError(next(iter(str(error).splitlines()), "unreadable")) from None
    if written != found:
        raise ValueError("checksum differs")
    return tensors, metadata
