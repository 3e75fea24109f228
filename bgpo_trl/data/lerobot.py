"""Demonstrations in LeRobot's format, version 3 (https://huggingface.co/docs/lerobot).

A folder holds a row for each frame in ``data/*/*.parquet``, with images as PNG files in a column,
and in ``meta/`` the features, the tasks, the episodes and statistics. Needs the extra ``lerobot``.
"""

from __future__ import annotations

import contextlib
import importlib.util
import itertools
import json
import warnings
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from bgpo_trl.data.dataset import resize_frames
from bgpo_trl.data.film import check_depth, decode_frame, decode_image, undamaged
from bgpo_trl.errors import UnreadableError, check_fetched

try:
    import pyarrow.parquet as pq
except ImportError as error:
    raise ImportError("LeRobot's format needs pyarrow: pip install 'bgpo_trl[lerobot]'") from error

_VIDEO = "videos/{}/chunk-{:03d}/file-{:03d}.mp4"

Episode = dict[str, Any]
"""Entries of an episode, see `write_demonstrations` and `write_logged_episodes`."""


def read_lerobot(
    path: str | Path,
    *,
    image_key: str | None = None,
    action_key: str | None = "action",
    state_key: str | None = None,
    joints_key: str | None = None,
    success_key: str | None = "next.success",
    frame_shape: Sequence[int] | None = None,
    episodes: Collection[int] | None = None,
    tasks: Collection[str] | None = None,
    stride: int = 1,
    combine: Callable[[NDArray[np.float32]], ArrayLike] | None = None,
    logged: bool = False,
) -> dict[str, list[Episode]]:
    """Read a LeRobot dataset of version 3 as demonstrations, or as logged episodes.

    The frames of the chosen episodes are held in memory, in the size of ``frame_shape``. Actions
    must have the meaning of the scene's, in [-1, 1]: scale them, or leave them out. Frames that are
    stored as video are decoded with PyAV, which is no part of the extra. There is a warning if a
    video goes on after an episode: a frame too many would shift those after it.

    Args:
        path: Folder of the LeRobot dataset.
        image_key: Name of the camera; may be left out if there is one, apart from depth maps.
        action_key: Feature with the actions; None leaves them out.
        state_key: Feature with the scene's ground truth; None leaves it out.
        joints_key: Feature with the readings of the scene's joints, such as
            ``"observation.state"``; None leaves them out.
        success_key: Feature that is true in a frame of each episode that succeeded, if the dataset
            has it; asked for if only others have success in their name. Failed episodes are
            refused; with None, they are read.
        frame_shape: Height and width to which frames are resized, see `resize_frames`; by default
            they stay as they are.
        episodes: Numbers of the episodes to read; None: all.
        tasks: Descriptions of the tasks to read; None: all.
        stride: Read every so many-th frame, the last one among them, which shows the success: 3
            turns 30 frames a second into 10.
        combine: With a stride, function from the actions between two frames that are read,
            ``[stride, A]``, to one action ``[A]``, such as their sum if they are displacements,
            or the last if they are targets.
        logged: Read episodes for `write_logged_episodes`, also failed ones, with ``success``.

    Returns:
        Episodes in their order by the description of their task: ``pixels`` uint8
        ``[T, H, W, 3]`` and, as asked for, ``action`` ``[T - 1, A]``, ``state`` ``[T, N]`` and
        ``joints`` ``[T, J]``, float32, and ``success``. Rename the tasks to those of the scene.

    Raises:
        ValueError: If the folder is no LeRobot dataset of version 3, a file is damaged or missing,
            an episode is incomplete or failed, a frame is missing or not at its time, images have
            more than 8 bits a color, a feature, episode or task to read is not there, or logged
            episodes do not say whether they succeeded.
    """
    wanted = {"action": action_key, "state": state_key, "joints": joints_key}
    chosen = {key: name for key, name in wanted.items() if name is not None}
    if stride < 1 or ("action" in chosen and stride > 1 and combine is None):
        raise ValueError(
            f"with stride {stride}, say how actions become one: combine=lambda a: a.sum(0) if they "
            "are displacements, a[-1] if they are targets; or leave them out, action_key=None"
        )
    reader = _Reader(Path(path), image_key, frame_shape)
    reader.check_numeric(chosen)
    like = [name for name in reader.features if "success" in name]
    may_lack = () if logged else (None, *([] if like else ["next.success"]))
    if success_key not in (*reader.features, *may_lack):
        raise ValueError(
            f"{path} has no {success_key!r}, by which episodes say whether they succeeded: give "
            f"one of its features as success_key, {', '.join(like or reader.features)}"
            + ("" if logged else ", or None to read all")
        )
    found = reader.read(chosen, success_key, episodes, tasks, stride, logged)
    if reader.doubt:
        warnings.warn(reader.doubt, stacklevel=2)
    if "action" in chosen and stride > 1 and combine is not None:
        for episode in itertools.chain(*found.values()):
            between = episode["action"].reshape(-1, stride, episode["action"].shape[-1])
            combined = [np.asarray(combine(some), np.float32) for some in between]
            episode["action"] = np.reshape(combined, between.shape[::2])
    return found


@contextlib.contextmanager
def _reading(source: object) -> Iterator[None]:
    """Turn whatever goes wrong with a file into one line."""
    if isinstance(source, Path):
        check_fetched(source)
    try:
        yield
    except UnreadableError as error:
        raise UnreadableError(f"{source}: {error}") from None
    except FileNotFoundError:
        raise UnreadableError(f"{source} is missing: give the folder of a whole dataset") from None
    except Exception as error:
        cause = " ".join(f"{type(error).__name__}: {error}".split())
        raise UnreadableError(f"{source} is damaged or of another format: {cause}") from error


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
            depth = {name for name, f in info["features"].items() if _is_depth(f)}
            self.n_episodes = int(info["total_episodes"])
            self.n_frames = int(info["total_frames"])
        if not version.startswith("v3."):
            raise ValueError(
                f"{path} has version {version}, not 3: convert it with LeRobot's "
                "convert_dataset_v21_to_v30"
            )
        pictures = [name for name, dtype in self.features.items() if dtype in ("image", "video")]
        cameras = [name for name in pictures if name not in depth]
        if not cameras:
            raise ValueError(
                f"{path} has no camera of colors, only {', '.join(self.features) or 'nothing'}: "
                "demonstrations are frames, record some"
            )
        if image_key is None and len(cameras) == 1:
            image_key = cameras[0]
        if image_key not in cameras:
            lacks = f"has a depth map {image_key!r}"
            if image_key not in depth:
                lacks = (
                    f"has no camera called {image_key!r}" if image_key else "has several cameras"
                )
            raise ValueError(f"{path} {lacks}: give one of {', '.join(cameras)} as image_key")
        self.path, self.image_key, self.frame_shape = path, image_key, frame_shape
        self.is_video = self.features[image_key] == "video"
        self._images: tuple[Path | None, Sequence[Any]] = (None, [])
        self._stored: tuple[int, ...] | None = None  # shape of the frames
        self.doubt = ""
        # Number and end (s) of the last episode of each film, by chunk and file.
        self._last: dict[tuple[int, int], tuple[int, float]] = {}
        if self.is_video and importlib.util.find_spec("av") is None:
            raise ValueError(
                f"{path} has its frames as video: pip install av (PyAV) to decode them, or decode "
                "them yourself for write_demonstrations"
            )

    def check_numeric(self, chosen: Mapping[str, str]) -> None:
        """Raise ``ValueError`` unless there are features of numbers with the chosen names."""
        for key, name in chosen.items():
            if not self.features.get(name, "").startswith(("float", "int", "uint")):
                numbers = [n for n, dtype in self.features.items() if dtype.startswith("float")]
                raise ValueError(
                    f"{self.path} has no numbers {name!r}: give the "
                    f"{key.removesuffix('s')}s' feature as {key}_key, "
                    f"one of {', '.join(numbers) or 'none'}, or None if there is none"
                )

    def read(
        self,
        chosen: Mapping[str, str],
        success_key: str | None,
        episodes: Collection[int] | None,
        tasks: Collection[str] | None,
        stride: int,
        logged: bool,
    ) -> dict[str, list[Episode]]:
        """Return the episodes by task, with some of the features under other keys."""
        names = self._task_names()
        success = [] if success_key not in self.features else [str(success_key)]
        indices = ["episode_index", "frame_index", "task_index"]
        rows = self._table("data", [*indices, "timestamp", *success], chosen.values())
        metadata = self._metadata({*rows["episode_index"]})
        by_episode = dict(iter(rows.sort_values("frame_index").groupby("episode_index")))
        for asked, there, what in (
            (episodes, metadata["episode_index"].tolist(), "episode"),
            (tasks, [*names.values()], "task"),
        ):
            missing = [one for one in (() if asked is None else asked) if one not in there]
            if missing:
                raise ValueError(
                    f"{self.path} has no {what} {np.asarray(missing[0]).item()!r}: choose among "
                    f"{_some(there)}"
                )
        found: dict[str, list[Episode]] = {
            name: [] for name in names.values() if tasks is None or name in tasks
        }
        failed = []
        for number, length, *place in metadata.itertuples(index=False):
            own = by_episode.get(number, rows[:0])
            if not length or [*own["frame_index"]] != [*range(length)]:
                raise ValueError(
                    f"episode {number} of {self.path} has {len(own)} of {length} frames: get it "
                    "again, or remove the episode with LeRobot's tools"
                )
            labels = {*own["task_index"]}
            if len(labels) > 1 or not labels <= {*names}:
                raise ValueError(
                    f"episode {number} of {self.path} has the tasks {sorted(labels)}: give each "
                    "episode one task that tasks.parquet names"
                )
            name = names[labels.pop()]
            if name not in found or (episodes is not None and number not in episodes):
                continue
            succeeded = not success or self._succeeded(number, own[success[0]])
            if not (succeeded or logged):
                failed.append(number)
            elif not failed:
                with _reading(f"episode {number} of {self.path}"):
                    episode = self._episode(own, chosen, place, stride)
                found[name].append({**episode, "success": succeeded} if logged else episode)
        if failed:
            raise ValueError(
                f"{self.path} has episodes that failed, without {success_key!r}: {_some(failed)}; "
                "name the others as episodes=..., or read all with success_key=None"
            )
        return found

    def _succeeded(self, number: int, column: pd.Series) -> bool:
        """Return whether a frame of an episode says that it succeeded."""
        flags = column.tolist()
        other = [flag for flag in flags if flag is not None and flag not in (0, 1)]
        if other:
            raise ValueError(
                f"episode {number} of {self.path} has the success {other[0]!r}, which is neither "
                "true nor false: give another feature as success_key, or None if there is none"
            )
        return any(flags)

    def _task_names(self) -> dict[int, str]:
        """Return the descriptions of the tasks, by index."""
        file = self.path / "meta" / "tasks.parquet"
        with _reading(file):
            # Written by pandas, descriptions are the index; by others, a column.
            tasks = pd.read_parquet(file)
            texts = [*tasks.get("task", tasks.index)]
            indices = [int(index) for index in _scalars(tasks["task_index"])]
            if not all(isinstance(text, str) for text in texts):
                raise UnreadableError(f"its tasks are {_some(texts)}, not descriptions")
            if len({*texts}) < len(texts) or len({*indices}) < len(indices):
                raise UnreadableError("it has a task or an index twice")
        return dict(zip(indices, texts, strict=True))

    def _metadata(self, recorded: set[int]) -> pd.DataFrame:
        """Return number and length of each episode and, for videos, its place."""
        prefix = f"videos/{self.image_key}/"
        videos = [prefix + name for name in ("chunk_index", "file_index", "from_timestamp")]
        columns = ["episode_index", "length", *(videos if self.is_video else [])]
        metadata = self._table("meta/episodes", columns).sort_values("episode_index")[columns]
        described = metadata["episode_index"].tolist()
        if len({*described}) < len(described) or not (
            {*described} == recorded and len(described) == self.n_episodes
        ):
            lacking = sorted({*described} ^ recorded)
            which = f", episodes {_some(lacking)} in one alone" if lacking else ""
            raise ValueError(
                f"{self.path} has {self.n_episodes} episodes by meta/info.json, {len(described)} "
                f"by meta/episodes and {len(recorded)} by data{which}: get it again whole"
            )
        if int(metadata["length"].sum()) != self.n_frames:
            raise ValueError(
                f"{self.path} has {self.n_frames} frames by meta/info.json, "
                f"{int(metadata['length'].sum())} by meta/episodes: get it again whole"
            )
        if self.is_video:
            self._place_in_films(metadata)
        return metadata

    def _place_in_films(self, metadata: pd.DataFrame) -> None:
        """Note where the last episode of each film ends; refuse episodes that overlap."""
        half = 0.5 / self.fps
        placed = metadata.sort_values([*metadata.columns[2:]])
        for number, length, chunk, file, start in placed.itertuples(index=False):
            last, end = self._last.get((chunk, file), (number, 0.0))
            if start < end - half:
                raise ValueError(
                    f"episode {number} of {self.path} begins in another one's frames, at "
                    f"{start:.3f} s of its film by meta/episodes: get it again whole"
                )
            # LeRobot's tools leave no gaps; where others have removed an episode, its number lacks.
            if start > end + half and number == last + 1:
                self._doubt_film(last, end, f"the next one begins at {start:.3f} s")
            self._last[chunk, file] = number, start + length / self.fps

    def _doubt_film(self, number: int, end: float, found: str) -> None:
        """Note the first episode after whose end (s) its film goes on, and what tells it."""
        self.doubt = self.doubt or (
            f"episode {number} of {self.path} ends at {end:.3f} s of its film by its length, "
            f"{found}: if a frame is in the film twice, those after it do not fit their actions; "
            "look at them, or record the episode again"
        )

    def _table(self, folder: str, scalars: list[str], others: Iterable[str] = ()) -> pd.DataFrame:
        """Return columns of all Parquet files of a folder, with ``file`` and ``row`` in it."""
        columns = [*scalars, *others]
        files = sorted((self.path / folder).glob("*/*.parquet")) or [self.path / folder]
        tables = []
        for file in files:
            with _reading(file):
                if not file.is_file():
                    raise FileNotFoundError
                table = pq.ParquetFile(file).read(columns).to_pandas()[columns]
                tables.append(table.assign(file=[file] * len(table), row=range(len(table))))
        table = pd.concat(tables)
        with _reading(self.path / folder):
            return table.assign(**{name: _scalars(table[name]) for name in scalars})

    def _episode(
        self, rows: pd.DataFrame, chosen: Mapping[str, str], place: Sequence[Any], stride: int
    ) -> Episode:
        """Return an episode from its rows and, for a video, the place of its first frame."""
        times = rows["timestamp"].to_numpy(np.float64)
        planned = np.arange(len(rows)) / self.fps
        if not (np.abs(times - times[0] - planned) <= 0.5 / self.fps).all():
            late = int((np.abs(times - times[0] - planned) > 0.5 / self.fps).argmax())
            raise UnreadableError(
                f"frame {late} is at {times[late]:.3f} s instead of {planned[late]:.3f} s: frames "
                "have to follow each other evenly"
            )
        n_read, first_read = (len(rows) - 1) // stride + 1, (len(rows) - 1) % stride
        frames = self._frames(rows[first_read::stride], times[first_read::stride], place)
        frames = map(self._of_one_shape, frames)
        if self.frame_shape is not None:
            frames = (resize_frames(frame[None], self.frame_shape)[0] for frame in frames)
        first = next(frames)
        pixels = np.empty((n_read, *first.shape), np.uint8)  # filled, since a stack would be twice
        for number, frame in enumerate(itertools.chain([first], frames)):
            pixels[number] = frame
        episode: Episode = {"pixels": pixels}
        for key, name in chosen.items():
            found = np.stack([np.atleast_1d(row) for row in rows[name]])
            values = found.astype(np.float32)
            if found.dtype.kind in "iu" and not np.array_equal(values, found):
                raise UnreadableError(f"{name} has whole numbers that are not exact as float32")
            values = values[first_read:]
            is_action = key == "action"
            episode[key] = values[: (n_read - 1) * stride] if is_action else values[::stride]
        return episode

    def _of_one_shape(self, frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
        self._stored = self._stored or frame.shape
        if frame.shape != self._stored:
            raise UnreadableError(
                f"its images differ in size, {[*self._stored]} and {[*frame.shape]}: make them "
                "alike"
            )
        return frame

    def _frames(
        self, rows: pd.DataFrame, times: NDArray[np.float64], place: Sequence[Any]
    ) -> Iterator[NDArray[np.uint8]]:
        """Return the frames of some rows of an episode, uint8 ``[H, W, 3]``."""
        if not self.is_video:
            for file, row in zip(rows["file"], rows["row"], strict=True):
                if self._images[0] != file:
                    column = pq.ParquetFile(file).read([self.image_key]).column(0).to_pylist()
                    self._images = file, column
                yield decode_image(self._image(self._images[1][row]))
            return
        chunk, file, start = place
        video = self.path / _VIDEO.format(self.image_key, int(chunk), int(file))
        with _reading(video):
            if not video.is_file():
                raise FileNotFoundError
            last, end = self._last[chunk, file]
            seconds = yield from _frames_at(video, start + times, 0.5 / self.fps, end)
            if seconds > end + 0.5 / self.fps:
                self._doubt_film(last, end, f"the film at {seconds:.3f} s")

    def _image(self, image: Mapping[str, Any]) -> bytes:
        """Return the content of an image, which is in its row or in a file of the dataset."""
        if image["bytes"] is not None:
            return image["bytes"]
        file = (self.path / str(image["path"])).resolve()
        if not file.is_relative_to(self.path.resolve()) or not file.is_file():
            raise UnreadableError(f"its image {image['path']!r} is no file of the dataset")
        check_fetched(file)
        return file.read_bytes()


def _is_depth(feature: Mapping[str, Any]) -> bool:
    """Return whether ``info.json`` calls a feature a depth map."""
    parts = [feature, *(part for part in feature.values() if isinstance(part, Mapping))]
    return any(value for part in parts for key, value in part.items() if "is_depth" in key)


def _scalars(column: pd.Series) -> NDArray[Any]:
    """Return a column of numbers, of which each may be in a list of its own."""
    cells = [np.ravel(cell).tolist() for cell in column]
    for cell in cells:
        if len(cell) != 1:
            raise UnreadableError(
                f"{column.name} has [{_some(cell)}] in a row: give one number a row"
            )
    return np.array(cells).ravel()


def _some(values: Sequence[Any]) -> str:
    """Return the first of some values for a message."""
    return ", ".join(map(str, values[:12])) + (", ..." if len(values) > 12 else "")


def _frames_at(
    path: Path, times: NDArray[np.float64], tolerance: float, end: float
) -> Generator[NDArray[np.uint8], None, float]:
    """Decode the frames nearest to some times (s), which ascend; return when the video ends (s).

    Raise `UnreadableError` if one is farther than the tolerance, or the video ends before ``end``.
    """
    av = importlib.import_module("av")
    with av.open(str(path)) as video:
        stream = video.streams.video[0]
        check_depth(stream)
        ticks, first = (getattr(stream, name, None) for name in ("duration", "start_time"))
        seconds = float(((first or 0) + (ticks or 0)) * stream.time_base)
        if ticks and seconds < end - tolerance:  # some formats do not say how long they are
            raise UnreadableError(
                f"it ends at {seconds:.3f} s, its last episode at {end:.3f} s: a frame was never "
                "encoded, and those after it would be taken for those before; get or record it "
                "again"
            )
        start = max(0, int((times[0] - tolerance) / stream.time_base))
        video.seek(start, stream=stream)  # to the keyframe before
        frames = undamaged(video.decode(stream))
        frame = next(frames, None)
        following = next(frames, None)
        for time in times:
            while frame and following and abs(following.time - time) <= abs(frame.time - time):
                frame, following = following, next(frames, None)
            if frame is None or abs(frame.time - time) > tolerance:
                raise UnreadableError(
                    f"there is no frame at {time:.3f} s: it was never encoded, and those after it "
                    "would be taken for those before; get or record it again"
                )
            yield decode_frame(frame)
    return seconds
