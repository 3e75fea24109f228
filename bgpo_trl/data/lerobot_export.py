"""Demonstrations of one's own as a dataset in LeRobot's format, which `lerobot` reads."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from PIL import Image
from tensordict import TensorDictBase
from torch import Tensor

from bgpo_trl.files.writing import new_folder, write_json

try:
    import pyarrow as pa
    import pyarrow.parquet as pq
except ImportError as error:
    raise ImportError("LeRobot's format needs pyarrow: pip install 'bgpo_trl[lerobot]'") from error

_DATA = "data/chunk-{:03d}/file-{:03d}.parquet"
_FILE_BYTES, _FILES_PER_CHUNK = 100 * 2**20, 1000
_INDICES = ("frame_index", "episode_index", "index", "task_index")
_KEYS = {
    "action": "action",
    "state": "observation.environment_state",
    "joints": "observation.state",
}


def write_lerobot(
    path: str | Path,
    dataset: TensorDictBase,
    *,
    tasks: Sequence[str],
    fps: int,
    image_key: str = "observation.images.camera",
    robot_type: str | None = None,
) -> None:
    """Write demonstrations as a LeRobot dataset, one episode for each.

    Frames are stored as PNG, hence without loss. A row of the format has an observation and the
    action that follows; that of the last frame is 0. Statistics are mean, standard deviation and
    range; LeRobot's ``augment_dataset_quantile_stats`` adds the quantiles that some policies need.

    Args:
        path: Folder of the LeRobot dataset, which must not exist.
        dataset: Demonstrations of `load_demonstrations`, or some, such as
            ``dataset[dataset["train"]]``. Reads ``pixels`` uint8 ``[N, T, H, W, 3]``, ``length``
            and ``task`` ``[N]``, and, if they are there, ``action`` ``[N, T - 1, A]``,
            ``state`` ``[N, T, F]`` (as ``observation.environment_state``) and ``joints``
            ``[N, T, J]`` (as ``observation.state``).
        tasks: Names or descriptions of the tasks, in the order of their labels.
        fps: Frames per second, 5 for NICO.
        image_key: Name of the camera.
        robot_type: Name of the robot.

    Raises:
        ValueError: If the folder exists, there is no demonstration, a label has no name, or ``fps``
            is not positive.
        OSError: If a file cannot be written; nothing is left.
    """
    if dataset.ndim != 1:
        raise ValueError("give a batch of demonstrations, of a single one dataset[:1]")
    if fps < 1 or not len(dataset):
        raise ValueError(
            f"there are {len(dataset)} demonstrations at {fps} frames per second: give at least 1"
        )
    if int(dataset["task"].max()) >= len(tasks) or len({*tasks}) < len(tasks):
        raise ValueError(f"{', '.join(tasks)}: give a name of its own for each label of the tasks")
    pixels, lengths = (cast(Tensor, dataset[key]) for key in ("pixels", "length"))
    length, task, frame_shape = lengths.numpy(), dataset["task"].tolist(), pixels.shape[-3:]
    end = length.cumsum()
    # Files of whole episodes, of about `_FILE_BYTES` before the frames are compressed.
    files = np.unique((end - length) * frame_shape.numel() // _FILE_BYTES, return_inverse=True)[1]
    episodes, numbers, colors = [], [], np.zeros((3, 256), np.int64)
    with new_folder(path) as folder:
        for file in range(int(files.max()) + 1):
            place, tables = divmod(file, _FILES_PER_CHUNK), []
            for row in np.flatnonzero(files == file).tolist():
                columns = _columns(cast(TensorDictBase, dataset[row]), row, end[row], fps)
                frames = pixels[row, : length[row]].numpy()
                counts = np.stack([np.bincount(c.ravel(), minlength=256) for c in frames.T])
                stats = {**_stats(columns), image_key: _color_stats(counts, len(frames))}
                episode = {
                    "episode_index": row,
                    "tasks": [tasks[task[row]]],
                    "length": int(length[row]),
                    "data/chunk_index": place[0],
                    "data/file_index": place[1],
                    "dataset_from_index": int(end[row] - length[row]),
                    "dataset_to_index": int(end[row]),
                    "meta/episodes/chunk_index": 0,
                    "meta/episodes/file_index": 0,
                }
                for name, of_feature in stats.items():
                    episode |= {f"stats/{name}/{kind}": v for kind, v in of_feature.items()}
                episodes.append(episode)
                tables.append(_table(columns, image_key, [*map(_png, frames)]))
                numbers.append(columns)
                colors += counts
            _write(folder / _DATA.format(*place), pa.concat_tables(tables))
        meta = folder / "meta"
        _write(meta / "episodes/chunk-000/file-000.parquet", pa.Table.from_pylist(episodes))
        index = pd.Index(tasks, name="task")
        pd.DataFrame({"task_index": range(len(tasks))}, index).to_parquet(meta / "tasks.parquet")
        columns = {name: np.concatenate([one[name] for one in numbers]) for name in numbers[0]}
        stats = {**_stats(columns), image_key: _color_stats(colors, int(end[-1]))}
        write_json(meta / "stats.json", stats)
        info = {
            "codebase_version": "v3.0",
            "robot_type": robot_type,
            "total_episodes": len(episodes),
            "total_frames": int(end[-1]),
            "total_tasks": len(tasks),
            "chunks_size": _FILES_PER_CHUNK,
            "data_files_size_in_mb": _FILE_BYTES // 2**20,
            "video_files_size_in_mb": 2 * _FILE_BYTES // 2**20,
            "fps": fps,
            "splits": {"train": f"0:{len(episodes)}"},
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "video_path": None,
            "features": _features(columns, image_key, [*frame_shape]),
        }
        write_json(meta / "info.json", info)


def _features(
    columns: Mapping[str, NDArray[Any]], image_key: str, frame_shape: list[int]
) -> dict[str, Any]:
    """Return the entry ``features`` of ``info.json``."""
    names = ["height", "width", "channels"]
    features: dict[str, Any] = {image_key: {"dtype": "image", "shape": frame_shape, "names": names}}
    for name, values in columns.items():
        size = values[0].size
        kind = name.removeprefix("observation.environment_")
        names = None if values.ndim == 1 else [f"{kind}_{n}" for n in range(size)]
        features[name] = {"dtype": str(values.dtype), "shape": [size], "names": names}
    return features


def _columns(row: TensorDictBase, number: int, end: int, fps: int) -> dict[str, NDArray[Any]]:
    """Return the numbers of an episode by the names of their features, a row for each frame."""
    length = int(row["length"])
    columns = {}
    for key, name in _KEYS.items():
        if key in row:
            n_known = length - (key == "action")
            values = cast(Tensor, row[key])
            columns[name] = np.zeros((length, values.shape[-1]), np.float32)
            columns[name][:n_known] = values[:n_known].numpy()
    columns["timestamp"] = np.arange(length, dtype=np.float32) / np.float32(fps)
    indices = (np.arange(length), number, np.arange(end - length, end), int(row["task"]))
    for name, values in zip(_INDICES, indices, strict=True):
        columns[name] = np.broadcast_to(np.asarray(values, np.int64), length)
    return columns


def _png(frame: NDArray[np.uint8]) -> bytes:
    content = io.BytesIO()
    Image.fromarray(frame).save(content, "png")
    return content.getvalue()


def _table(
    columns: Mapping[str, NDArray[Any]], image_key: str, images: Sequence[bytes]
) -> pa.Table:
    """Return the rows of an episode; a feature of one number is a plain column."""
    pictures = [{"bytes": image, "path": f"frame-{n:06d}.png"} for n, image in enumerate(images)]
    arrays = {image_key: pa.array(pictures, pa.struct({"bytes": pa.binary(), "path": pa.string()}))}
    for name, values in columns.items():
        flat = pa.array(values.reshape(-1))
        size = values[0].size
        arrays[name] = flat if size == 1 else pa.FixedSizeListArray.from_arrays(flat, size)
    return pa.table(arrays)


def _write(path: Path, table: pa.Table) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path)


def _stats(columns: Mapping[str, NDArray[Any]]) -> dict[str, dict[str, list[float]]]:
    """Return the statistics of numbers by the names of their features."""
    stats = {}
    for name, values in columns.items():
        found = {kind: getattr(values, kind)(0) for kind in ("min", "max", "mean", "std")}
        stats[name] = {kind: np.atleast_1d(v).astype(float).tolist() for kind, v in found.items()}
        stats[name]["count"] = [len(values)]
    return stats


def _color_stats(counts: NDArray[np.int64], n_frames: int) -> dict[str, Any]:
    """Return the statistics of frames, by color in [0, 1], from counts of values ``[3, 256]``."""
    values, share = np.arange(256) / 255, counts / counts.sum(1, keepdims=True)
    mean = share @ values
    found = {
        "min": [values[of_color > 0].min() for of_color in counts],
        "max": [values[of_color > 0].max() for of_color in counts],
        "mean": mean,
        "std": (share * (values - mean[:, None]) ** 2).sum(1) ** 0.5,
    }
    shaped = {kind: np.reshape(value, (3, 1, 1)).tolist() for kind, value in found.items()}
    return {**shaped, "count": [n_frames]}
