"""Read a LeRobot dataset as episodes for `write_demonstrations`."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
from numpy.typing import NDArray
from PIL import Image

from bgpo_trl.data.writing import resize_frames

_VIDEO = "videos/{}/chunk-{:03d}/file-{:03d}.mp4"

Episode = dict[str, NDArray[Any]]
"""Entries of an episode, see `write_demonstrations`."""


def read_lerobot(
    path: str | Path,
    *,
    image_key: str | None = None,
    action_key: str | None = "action",
    state_key: str | None = None,
    frame_shape: Sequence[int] | None = None,
) -> dict[str, list[Episode]]:
    """Read a LeRobot dataset of version 3 as episodes for `write_demonstrations`.

    All frames are held in memory. Actions must have the meaning of the scene's, in [-1, 1]: scale
    them, or leave them out. Frames that are stored as video are decoded with PyAV, which is no part
    of the extra.

    Args:
        path: Folder of the LeRobot dataset.
        image_key: Name of the camera; may be left out if there is one.
        action_key: Feature with the actions; None, or a name that is not there, leaves them out.
        state_key: Feature with the scene's ground truth; None leaves it out.
        frame_shape: Height and width to which frames are resized, see `resize_frames`; by default
            they stay as they are.

    Returns:
        Episodes in their order by the description of their task: ``pixels`` uint8
        ``[T, H, W, 3]`` and, as asked for, ``action`` ``[T - 1, A]`` and ``state`` ``[T, N]``,
        float32. Rename the tasks to those of the scene.

    Raises:
        ValueError: If the folder is no LeRobot dataset of version 3, a file is damaged or missing,
            or an episode is incomplete.
    """
    reader = _Reader(Path(path), image_key, frame_shape)
    if state_key is not None and state_key not in reader.features:
        raise ValueError(f"{path} has no {state_key!r}, only {', '.join(reader.features)}")
    wanted = (("action", action_key), ("state", state_key))
    return reader.read({key: name for key, name in wanted if name and name in reader.features})


@contextlib.contextmanager
def _reading(source: object) -> Iterator[None]:
    """Turn whatever goes wrong with a file into one line."""
    try:
        yield
    except FileNotFoundError:
        raise ValueError(f"{source} is missing: give the folder of a whole dataset") from None
    except Exception as error:
        cause = " ".join(f"{type(error).__name__}: {error}".split())
        raise ValueError(f"{source} is damaged or of another format: {cause}") from error


class _Reader:
    """A LeRobot dataset."""

    def __init__(
        self, path: Path, image_key: str | None, frame_shape: Sequence[int] | None
    ) -> None:
        file = path / "meta" / "info.json"
        with _reading(file):
            info = json.loads(file.read_text())
            self.fps, version = float(info["fps"]), str(info["codebase_version"])
            self.features = {name: str(f["dtype"]) for name, f in info["features"].items()}
        if not version.startswith("v3."):
            raise ValueError(
                f"{path} has version {version}, not 3: convert it with LeRobot's "
                "convert_dataset_v21_to_v30"
            )
        cameras = [name for name, dtype in self.features.items() if dtype in ("image", "video")]
        if image_key is None and len(cameras) == 1:
            image_key = cameras[0]
        if image_key is None or image_key not in cameras:
            raise ValueError(
                f"{path} has the cameras {', '.join(cameras) or 'none'}: name one as image_key"
            )
        self.path, self.image_key, self.frame_shape = path, image_key, frame_shape
        self.is_video = self.features[image_key] == "video"
        if self.is_video and importlib.util.find_spec("av") is None:
            raise ValueError(
                f"{path} has its frames as video: pip install av (PyAV) to decode them, or decode "
                "them yourself for write_demonstrations"
            )

    def read(self, chosen: Mapping[str, str]) -> dict[str, list[Episode]]:
        """Return the episodes by task, with some of the features under other keys."""
        file = self.path / "meta" / "tasks.parquet"
        with _reading(file):
            tasks = pd.read_parquet(file)["task_index"]
            names = {int(index): str(name) for name, index in tasks.items()}
        images = [] if self.is_video else [self.image_key]
        rows = self._table(
            "data", ["episode_index", "frame_index", "task_index", *chosen.values(), *images]
        )
        by_episode = dict(iter(rows.sort_values("frame_index").groupby("episode_index")))
        prefix = f"videos/{self.image_key}/"
        videos = [prefix + name for name in ("chunk_index", "file_index", "from_timestamp")]
        columns = ["episode_index", "length", *(videos if self.is_video else [])]
        metadata = self._table("meta/episodes", columns).sort_values("episode_index")
        episodes: dict[str, list[Episode]] = {name: [] for name in names.values()}
        for number, length, *place in metadata.itertuples(index=False):
            found = by_episode.get(number, rows[:0])
            if not length or [*found["frame_index"]] != [*range(length)]:
                raise ValueError(
                    f"episode {number} of {self.path} has {len(found)} of {length} frames: get it "
                    "again, or remove the episode with LeRobot's tools"
                )
            labels = {*found["task_index"]}
            if len(labels) > 1 or not labels <= {*names}:
                raise ValueError(
                    f"episode {number} of {self.path} has the tasks {sorted(labels)}: give each "
                    "episode one task that tasks.parquet names"
                )
            with _reading(f"episode {number} of {self.path}"):
                episode = self._episode(found, chosen, place)
            episodes[names[labels.pop()]].append(episode)
        return episodes

    def _table(self, folder: str, columns: list[str]) -> pd.DataFrame:
        """Return columns of all Parquet files of a folder."""
        files = sorted((self.path / folder).glob("*/*.parquet")) or [self.path / folder]
        tables = []
        for file in files:
            with _reading(file):
                if not file.is_file():
                    raise FileNotFoundError
                tables.append(pq.ParquetFile(file).read(columns).to_pandas()[columns])
        return pd.concat(tables)

    def _episode(
        self, rows: pd.DataFrame, chosen: Mapping[str, str], place: Sequence[Any]
    ) -> Episode:
        """Return an episode from its rows and, for a video, the place of its first frame."""
        length = len(rows)
        if self.is_video:
            chunk, file, start = place
            video = self.path / _VIDEO.format(self.image_key, int(chunk), int(file))
            frames = [*itertools.islice(_decode(video, start - 0.5 / self.fps), length)]
        else:
            frames = [
                np.asarray(Image.open(io.BytesIO(image["bytes"])).convert("RGB"))
                for image in rows[self.image_key]
            ]
        if len(frames) < length:
            raise ValueError(f"its video has {len(frames)} of {length} frames")
        pixels = np.stack(frames)
        if self.frame_shape is not None:
            pixels = resize_frames(pixels, self.frame_shape)
        episode: Episode = {"pixels": pixels}
        for key, name in chosen.items():
            values = np.stack([np.atleast_1d(row) for row in rows[name]]).astype(np.float32)
            episode[key] = values[: length - (key == "action")]
        return episode


def _decode(path: Path, start: float) -> Iterator[NDArray[np.uint8]]:
    """Decode the frames of a video from a time (s) on."""
    av = importlib.import_module("av")
    with av.open(str(path)) as video:
        stream = video.streams.video[0]
        video.seek(max(0, int(start / stream.time_base)), stream=stream)  # to the keyframe before
        for frame in video.decode(stream):
            if frame.time >= start:
                yield frame.to_ndarray(format="rgb24")
