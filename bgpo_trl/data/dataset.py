"""Files of a recorded dataset of demonstrations (frames, states, actions), and loading them."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import MemoryMappedTensor, TensorDict

from bgpo_trl.files.writing import make_folder, write_json
from bgpo_trl.scenes import SCENES, Scene, find_scene

_META = "dataset.json"
_REMEDY = (
    "record it again with `python -m bgpo_trl.data.recording PATH` (a robot other than NICO: "
    "--scene), or write it again"
)


def load_demonstrations(path: str | Path, *, verify: bool = True) -> TensorDict:
    """Open a dataset of `record_demonstrations` or `write_demonstrations`, memory-mapped.

    ``verify`` compares the checksum, which reads the whole dataset.

    Raises:
        ValueError: If it is missing, incomplete, damaged or of another version of its scene.
    """
    path = Path(path)
    meta = read_meta(path)
    # The scene of demonstrations from elsewhere need not be known here.
    version = find_scene(meta["scene"]).version if meta["scene"] in SCENES else None
    if version not in (None, meta["scene_version"]):
        raise ValueError(
            f"{path} was recorded in scene {meta['scene_version']!r}, this is {version}; {_REMEDY}"
        )
    if not meta.get("checksum"):
        raise ValueError(
            f"the recording at {path} is not complete; resume it with the same command"
        )
    dataset = open_dataset(path, meta)
    if verify and checksum_of(dataset) != meta["checksum"]:
        raise ValueError(f"{path} is damaged (checksum differs); remove it and {_REMEDY}")
    return dataset


def is_dataset(path: Path) -> bool:
    """Return whether a folder holds a recording, complete or not."""
    return (path / _META).exists()


def layout_of(
    scene: Scene, *, max_steps: int | None = None, actions: bool = True, states: bool = True
) -> dict[str, Any]:
    """Return the settings that fix the sizes of a dataset of a scene.

    Args:
        scene: The robot.
        max_steps: Length of the longest episode; by default the scene's.
        actions: Whether the actions are known.
        states: Whether the ground truth is known, if the scene has some.
    """
    return {
        "scene": scene.name,
        "scene_version": scene.version,
        "frame_shape": [*scene.frame_shape],
        "max_steps": max_steps or scene.max_steps,
        "action_size": scene.action_size if actions else 0,
        "state_size": scene.state.size if states and scene.state is not None else 0,
    }


def make_dataset(path: Path, meta: Mapping[str, Any]) -> TensorDict:
    """Make the files of empty rows, given the settings.

    Raises:
        OSError: If there is not enough disk space.
    """
    make_folder(path)
    dataset = _empty(meta)
    size = sum(value.numel() * value.element_size() for _, value in dataset.items())
    free = shutil.disk_usage(path).free
    if size > free:  # Writing to a memory map on a full disk would kill the process.
        raise OSError(
            f"the dataset takes {size / 1e9:.1f} GB, {path} has {free / 1e9:.1f} GB left: "
            "make room or choose another folder"
        )
    return dataset.memmap_like(str(path))


def open_dataset(path: Path, meta: Mapping[str, Any]) -> TensorDict:
    """Open the files, memory-mapped, given the settings.

    Raises:
        ValueError: If a file is missing or has another size.
    """
    expected = _empty(meta)
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
    return TensorDict(tensors, expected.batch_size)


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
    if not isinstance(meta, dict) or not _is_complete(meta):
        raise ValueError(f"{path / _META} is damaged; remove {path} and {_REMEDY}")
    return meta


def _is_complete(meta: Mapping[str, Any]) -> bool:
    """Return whether settings name tasks and scene, and sizes that a dataset can have."""
    sizes = ("max_steps", "action_size", "state_size")
    return (
        isinstance(meta.get("tasks"), list)
        and isinstance(meta.get("scene"), str)
        and isinstance(meta.get("scene_version"), str)
        and isinstance(meta.get("frame_shape"), list)
        and len(meta["frame_shape"]) == 2
        and all(isinstance(size, int) and 0 < size < 2**13 for size in meta["frame_shape"])
        and all(isinstance(meta.get(name), int) and 0 <= meta[name] < 2**20 for name in sizes)
        and isinstance(meta.get("rows"), int)
        and 0 < meta["rows"] < 2**31
    )


def _empty(meta: Mapping[str, Any]) -> TensorDict:
    n, steps = meta["rows"], meta["max_steps"]
    number = torch.zeros((), dtype=torch.int64)
    columns = {
        "pixels": torch.zeros((), dtype=torch.uint8).expand(n, steps + 1, *meta["frame_shape"], 3),
        "length": number.expand(n),
        "task": number.expand(n),
        "train": torch.zeros((), dtype=torch.bool).expand(n),
        "seed": number.expand(n),
    }
    if meta["state_size"]:
        columns["state"] = torch.zeros(()).expand(n, steps + 1, meta["state_size"])
    if meta["action_size"]:
        columns["action"] = torch.zeros(()).expand(n, steps, meta["action_size"])
    return TensorDict(columns, [n])
