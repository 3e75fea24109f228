"""Files of tensors, safetensors with a checksum: what is read is what was written, or an error."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from bgpo_trl.files.folders import make_folder


def digest(tensors: Mapping[str, Tensor]) -> str:
    """Returns the SHA-256 of the names and the bytes of tensors."""
    sha256 = hashlib.sha256()
    for key in sorted(tensors):
        sha256.update(key.encode())
        sha256.update(tensors[key].cpu().contiguous().numpy().tobytes())
    return sha256.hexdigest()


def _checksum(tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> str:
    told = json.dumps([digest(tensors), dict(metadata)], sort_keys=True)
    return hashlib.sha256(told.encode()).hexdigest()


def save_tensors(
    path: str | os.PathLike[str], tensors: Mapping[str, Tensor], metadata: Mapping[str, str]
) -> None:
    """Writes tensors and what is to be known of them; missing folders are made.

    Raises:
        OSError: If the file cannot be written; one that was there stays as it was.
    """
    path = Path(path)
    make_folder(path.parent)
    # Written aside first: an interrupted save must not destroy the file that was there.
    partial = path.with_suffix(".partial")
    contiguous = {key: value.contiguous() for key, value in tensors.items()}
    try:
        save_file(contiguous, partial, {**metadata, "sha256": _checksum(contiguous, metadata)})
        os.replace(partial, path)
    except (SafetensorError, OSError) as error:
        partial.unlink(missing_ok=True)
        raise OSError(f"cannot write {path} ({error}): make room, or choose another path") from None


def load_tensors(path: str | os.PathLike[str]) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Reads what `save_tensors` wrote.

    Returns:
        The tensors and the metadata.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is damaged, or no such file; the message only says how.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(path)
    try:
        with safe_open(path, "pt") as file:
            metadata = dict(file.metadata() or {})
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        written = metadata.pop("sha256", None)
        found = _checksum(tensors, metadata)
    except Exception as error:  # The library raises errors of many kinds.
        raise ValueError(next(iter(str(error).splitlines()), "unreadable")) from None
    if written != found:
        raise ValueError("checksum differs")
    return tensors, metadata
