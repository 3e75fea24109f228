"""Files of a recorded dataset of demonstrations (frames, states, actions), and loading them."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path

import torch
from tensordict import MemoryMappedTensor, TensorDict

from bgpo_trl.files.writing import make_folder, write_json
from suites import nico
from suites.nico.base import STATE_SIZE
from suites.nico.rendering import FRAME_HEIGHT, FRAME_WIDTH

MAX_STEPS = 50
"""Actions of the longest demonstration."""

_META = "dataset.json"
_REMEDY = "record it again with `python -m bgpo_trl.data.recording PATH`"


def load_demonstrations(path: str | Path, *, verify: bool = True) -> TensorDict:
    """Open a dataset recorded by `record_demonstrations`, memory-mapped.

    ``verify`` compares the checksum, which reads the whole dataset.

    Raises:
        ValueError: If it is missing, incomplete, damaged or of another scene version.
    """
    path = Path(path)
    meta = read_meta(path)
    version = nico.scene_version()
    if meta.get("scene_version") != version:
        raise ValueError(
            f"{path} was recorded in scene {meta.get('scene_version')!r}, this is {version}; "
            f"{_REMEDY}"
        )
    if not meta.get("checksum"):
        raise ValueError(
            f"the recording at {path} is not complete; resume it with the same command"
        )
    dataset = open_dataset(path, meta["per_task"] * len(meta["tasks"]))
    if verify and checksum_of(dataset) != meta["checksum"]:
        raise ValueError(f"{path} is damaged (checksum differs); remove it and {_REMEDY}")
    return dataset


def is_dataset(path: Path) -> bool:
    """Return whether a folder holds a recording, complete or not."""
    return (path / _META).exists()


def make_dataset(path: Path, n: int) -> TensorDict:
    """Make the files of ``n`` empty rows.

    Raises:
        OSError: If there is not enough disk space.
    """
    make_folder(path)
    dataset = _empty(n)
    size = sum(value.numel() * value.element_size() for _, value in dataset.items())
    free = shutil.disk_usage(path).free
    if size > free:  # Writing to a memory map on a full disk would kill the process.
        raise OSError(
            f"the dataset takes {size / 1e9:.1f} GB, {path} has {free / 1e9:.1f} GB left: "
            "make room or choose another folder"
        )
    return dataset.memmap_like(str(path))


def open_dataset(path: Path, n: int) -> TensorDict:
    """Open the files of ``n`` rows, memory-mapped.

    Raises:
        ValueError: If a file is missing or has another size.
    """
    expected = _empty(n)
    for key, value in expected.items():
        file = path / f"{key}.memmap"
        size = value.numel() * value.element_size()
        if not file.exists() or file.stat().st_size != size:
            raise ValueError(f"{file} is missing or truncated; remove {path} and {_REMEDY}")
    # Not TensorDict.load_memmap, which trusts the dtypes and shapes of its meta.json; the checksum
    # does not cover that file.
    tensors = {
        key: MemoryMappedTensor.from_filename(
            path / f"{key}.memmap", dtype=value.dtype, shape=value.shape
        )
        for key, value in expected.items()
    }
    return TensorDict(tensors, [n])


def checksum_of(dataset: TensorDict) -> str:
    """Return the digest of all tensors."""
    digest = hashlib.sha256()
    for _, tensor in sorted(dataset.items()):
        for rows in tensor.split(256):
            digest.update(rows.numpy().data)
    return digest.hexdigest()


def write_meta(path: Path, meta: dict) -> None:
    """Write the settings of a recording, and the checksum of a complete one, atomically."""
    write_json(path / _META, meta)


def read_meta(path: Path) -> dict:
    """Return the settings of a recording, with ``checksum`` if it is complete.

    Raises:
        ValueError: If there is no recording, or its settings are damaged.
    """
    try:
        meta = json.loads((path / _META).read_text())
    except OSError:
        if not path.exists():
            raise ValueError(f"there is no dataset at {path}; {_REMEDY}") from None
        raise ValueError(f"{path} is not a dataset of demonstrations; {_REMEDY}") from None
    except (ValueError, RecursionError):
        meta = None
    if not isinstance(meta, dict) or not (
        isinstance(meta.get("tasks"), list)
        and isinstance(meta.get("per_task"), int)
        and 0 < meta["per_task"] < 2**31
    ):
        raise ValueError(f"{path / _META} is damaged; remove {path} and {_REMEDY}")
    return meta


def _empty(n: int) -> TensorDict:
    frames = MAX_STEPS + 1
    return TensorDict(
        {
            "pixels": torch.zeros((), dtype=torch.uint8).expand(
                n, frames, FRAME_HEIGHT, FRAME_WIDTH, 3
            ),
            "state": torch.zeros(()).expand(n, frames, STATE_SIZE),
            "action": torch.zeros(()).expand(n, MAX_STEPS, 4),
            "length": torch.zeros((), dtype=torch.int64).expand(n),
            "task": torch.zeros((), dtype=torch.int64).expand(n),
            "train": torch.zeros((), dtype=torch.bool).expand(n),
            "seed": torch.zeros((), dtype=torch.int64).expand(n),
        },
        [n],
    )
