"""Datasets of demonstrations: their files, loading them, and writing those made elsewhere."""

from __future__ import annotations

import contextlib
import hashlib
import json
import shutil
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from operator import index
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import MemoryMappedTensor, TensorDict, TensorDictBase
from torch import Tensor

from bgpo_trl.errors import as_shape, check_fetched
from bgpo_trl.files.writing import make_folder, new_folder, write_json
from bgpo_trl.scenes import SCENES, Scene, find_scene

META = "dataset.json"
"""File with the settings of a recording and, once it is complete, its checksum."""
_REMEDY = (
    "record it again with `bgpo record PATH` (a robot other than NICO: --scene), or write it again"
)


def load_demonstrations(path: str | Path) -> TensorDict:
    """Open a dataset of `record_demonstrations` or `write_demonstrations`, memory-mapped.

    What is written to it changes its files, which would then be refused as damaged: change a copy,
    ``dataset.to_tensordict()``.

    Raises:
        ValueError: If it is missing, incomplete, damaged, of another version of its scene, or of
            logged episodes, which may have failed.
    """
    dataset, meta = open_complete(Path(path))
    if meta.get("logged"):
        raise ValueError(
            f"{path} holds logged episodes, which may have failed and are no demonstrations: give "
            "them to a run (--logged), or write successful ones with write_demonstrations"
        )
    return dataset


def open_complete(path: Path) -> tuple[TensorDict, dict[str, Any]]:
    """Open demonstrations or logged episodes, memory-mapped; return them and their settings.

    Raises:
        ValueError: If they are missing, incomplete, damaged or of another version of their scene.
    """
    meta = read_meta(path)
    if meta["scene"] in SCENES:  # That of demonstrations from elsewhere need not be known here.
        scene = find_scene(meta["scene"])
        if scene.full_version != meta["scene_version"]:
            raise ValueError(
                f"{path} was recorded in scene {meta['scene_version']!r}, this is "
                f"{scene.full_version}; {_REMEDY}"
            )
        known = layout_of(scene, NUMBERS, meta["max_steps"])
        for key in ("frame_shape", "action_size", "state_size", "joint_size"):
            found, needed = meta.get(key), known.get(key, 0)
            if found and found != needed:  # 0 numbers are those that are not stored
                raise ValueError(
                    f"{path} has the {key} {found}, the scene {scene.name!r} {needed}; {_REMEDY}"
                )
    if not meta.get("checksum"):
        raise ValueError(
            f"the recording at {path} is not complete; resume it with the same command"
        )
    dataset = open_dataset(path, meta)
    if checksum_of(dataset) != meta["checksum"]:
        raise ValueError(f"{path} is damaged (checksum differs); remove it and {_REMEDY}")
    return dataset, meta


def layout_of(scene: Scene, known: Collection[str], max_steps: int) -> dict[str, Any]:
    """Return the settings that fix the sizes of a dataset of a scene, given the known `NUMBERS`."""
    state = scene.state if "state" in known else None
    joints = scene.joints if "joints" in known else None
    return {
        "scene": scene.name,
        "scene_version": scene.full_version,
        "frame_shape": [*scene.frame_shape],
        "max_steps": max_steps,
        "action_size": scene.action_size if "action" in known else 0,
        "state_size": 0 if state is None else state.size,
        **({} if joints is None else {"joint_size": joints.size}),
    }


def make_dataset(path: Path, meta: Mapping[str, Any]) -> TensorDict:
    """Make the files of empty rows, given the settings.

    Raises:
        ValueError: If the folder holds rows of a recording that was killed, or lost its settings.
        OSError: If there is not enough disk space.
    """
    make_folder(path)
    if any(path.glob("*.memmap")):
        raise ValueError(
            f"{path} holds rows of a recording without {META}: remove it or choose another folder"
        )
    columns = _empty(meta)
    size, free = sum(v.nbytes for v in columns.values()), shutil.disk_usage(path).free
    if size > free:  # Writing to a memory map on a full disk would kill the process.
        raise OSError(
            f"the dataset takes {size / 1e9:.1f} GB, {path} has {free / 1e9:.1f} GB left: "
            "make room or choose another folder"
        )
    return TensorDict(columns, [meta["rows"]]).memmap_like(str(path))


def open_dataset(path: Path, meta: Mapping[str, Any]) -> TensorDict:
    """Open the files, memory-mapped, given the settings.

    Raises:
        ValueError: If a file is missing or has another size.
    """
    # Not TensorDict.load_memmap, which trusts the dtypes and shapes of its meta.json; the checksum
    # does not cover that file.
    columns = _empty(meta)
    for key, value in columns.items():
        file = path / f"{key}.memmap"
        check_fetched(file)
        if not file.exists() or file.stat().st_size != value.nbytes:
            raise ValueError(f"{file} is missing or truncated; remove {path} and {_REMEDY}")
        kind = {"dtype": value.dtype, "shape": value.shape}
        columns[key] = MemoryMappedTensor.from_filename(file, **kind)
    return TensorDict(columns, [meta["rows"]])


def fill_row(
    dataset: TensorDict, row: int, episode: Mapping[str, Any], task: int, train: bool
) -> None:
    """Write an episode to a row, whose length comes last: a row of length 0 is recorded again."""
    for key, values in episode.items():
        values = torch.from_numpy(np.asarray(values).copy())
        steps = [slice(len(values))] if values.ndim else []  # none of success
        dataset[key][(row, *steps)] = values
    dataset["task"][row], dataset["train"][row] = task, train
    dataset["length"][row] = len(episode["pixels"])


def checksum_of(dataset: TensorDict) -> str:
    """Return the digest of all tensors."""
    digest = hashlib.sha256()
    for _, tensor in sorted(dataset.items()):
        for rows in tensor.split(256):
            digest.update(rows.numpy().data)
    return digest.hexdigest()


def read_meta(path: Path) -> dict:
    """Return the settings of a recording, with ``checksum`` if it is complete.

    Raises:
        ValueError: If there is no recording, or its settings are damaged.
    """
    check_fetched(path / META)
    try:
        meta = json.loads((path / META).read_text())
    except OSError:
        if not path.exists():
            raise ValueError(f"there is no dataset at {path}; {_REMEDY}") from None
        raise ValueError(f"{path} is not a dataset of demonstrations; {_REMEDY}") from None
    except (ValueError, RecursionError):
        meta = None
    if not isinstance(meta, dict) or not _is_complete(meta):
        raise ValueError(f"{path / META} is damaged; remove {path} and {_REMEDY}")
    return meta


def scene_of(meta: Mapping[str, Any]) -> str:
    """Return the identity of the scene that a recording's settings name, as `Scene.identity`."""
    return f"{meta['scene']} {meta['scene_version']}"


def check_scene(
    identity: str | None, *datasets: TensorDictBase | Mapping[str, Tensor] | None
) -> None:
    """Check that datasets show the scene of encoders, given its identity.

    Only those opened from files tell, before rows of them are selected; others are accepted.

    Raises:
        ValueError: If one shows another scene, or another version of it.
    """
    for dataset in datasets:
        file = None if dataset is None else getattr(dataset["pixels"], "filename", None)
        if identity is None or file is None or not (path := Path(file).parent / META).is_file():
            continue
        meta = read_meta(path.parent)
        found = scene_of(meta)
        if found != identity:
            raise ValueError(
                f"{path.parent} shows the scene {found}, the encoders {identity}: give recordings "
                "and encoders of the same"
            )


def _is_complete(meta: Mapping[str, Any]) -> bool:
    """Return whether settings name tasks and scene, and sizes that a dataset can have."""
    shape = meta.get("frame_shape")
    if not isinstance(shape, list) or len(shape) != 2:
        return False
    sizes = [
        *((meta.get(key), 0, 2**20) for key in ("max_steps", "action_size", "state_size")),
        *((side, 1, 2**13) for side in shape),
        (meta.get("joint_size", 1), 1, 2**20),
        (meta.get("rows"), 1, 2**31),
    ]
    return (
        isinstance(meta.get("tasks"), list)
        and isinstance(meta.get("scene"), str)
        and isinstance(meta.get("scene_version"), str)
        and all(type(size) is int and least <= size < end for size, least, end in sizes)
    )


def _empty(meta: Mapping[str, Any]) -> dict[str, Tensor]:
    """Return zeros of the types and shapes of a dataset, without memory of their own."""
    n, n_frames = meta["rows"], meta["max_steps"] + 1
    shapes: dict[str, tuple[torch.dtype, list[int]]] = {
        "pixels": (torch.uint8, [n_frames, *meta["frame_shape"], 3]),
        "length": (torch.int64, []),
        "task": (torch.int64, []),
        "train": (torch.bool, []),
        "seed": (torch.int64, []),
    }
    if meta["state_size"]:
        shapes["state"] = (torch.float32, [n_frames, meta["state_size"]])
    if "joint_size" in meta:
        shapes["joints"] = (torch.float32, [n_frames, meta["joint_size"]])
    if meta["action_size"]:
        shapes["action"] = (torch.float32, [n_frames - 1, meta["action_size"]])
    if meta.get("logged"):
        shapes["success"] = (torch.bool, [])
    return {key: torch.zeros((), dtype=d).expand(n, *shape) for key, (d, shape) in shapes.items()}


Episodes = Mapping[str, Sequence[Mapping[str, Any]]]
"""Episodes by the name of their task; for an episode's entries, see `write_demonstrations`."""
NUMBERS = ("action", "state", "joints")
"""Entries of an episode, beside its frames, that may be known."""
_KEYS = ("pixels", *NUMBERS)
_IDLE = 5  # steps; shorter ones may be part of a task


def write_demonstrations(
    path: str | Path,
    episodes: Episodes,
    *,
    scene: Scene | str,
    held_out_per_task: int,
    spread: float = 1.0,
) -> TensorDict:
    """Write demonstrations as a dataset that trains encoders and makes banks.

    An episode is a mapping with ``pixels`` uint8 ``[T, H, W, 3]``, frames of the scene's size with
    ``T`` of at least 2; ``action`` ``[T - 1, A]`` in [-1, 1], from each frame to the next and with
    the meaning of the scene's actions; ``joints`` ``[T, J]``, readings of the robot's joints; and
    ``state`` ``[T, N]``, the ground truth. All but frames may be left out of all episodes, but not
    of some. Without actions, encoders have no inverse model, unless play is recorded for it, and
    banks no steps: demonstrations then tell the task, but are no experience. Without joints, they
    are none for policies that read joints. The ground truth serves probes alone.

    All episodes are checked before anything is written; a warning names episodes without movement,
    such as are given twice, and joints far from the scene's center. Each is indexed twice, so a
    sequence may load its episodes from files on demand.

    Args:
        path: Folder of the dataset, which must not exist.
        episodes: Episodes by the name of their task, in the order of the labels.
        scene: The robot, or its name.
        held_out_per_task: How many of each task are held out for test episodes: the last ones.
        spread: Share of the whole range of start states that the demonstrations cover.

    Returns:
        A memory-mapped TensorDict ``[N]``, as of `record_demonstrations`; ``seed`` is 0.

    Raises:
        ValueError: If an argument or an episode is invalid; it names the episode by its task and
            its position, from 0.
        OSError: If there is not enough disk space, or the folder cannot be written.

    Examples:
        >>> frames = np.zeros((5, 32, 64, 3), np.uint8)
        >>> episodes = {"grasp_glass": [{"pixels": frames}, {"pixels": frames[:3]}]}
        >>> path = getfixture("tmp_path") / "own"
        >>> dataset = write_demonstrations(path, episodes, scene="nico", held_out_per_task=1)
        >>> dataset["length"].tolist(), dataset["train"].tolist()
        ([5, 3], [True, False])
    """
    scene = find_scene(scene)
    scene.check_spread(spread)
    # NumPy's integers cannot be written as JSON.
    settings = {"held_out_per_task": index(held_out_per_task), "spread": float(spread)}
    return _write(Path(path), scene, episodes, settings)


def write_logged_episodes(path: str | Path, episodes: Episodes, *, scene: Scene | str) -> None:
    """Write logged episodes, also failed ones, as a dataset that runs begin with (``--logged``).

    Args:
        path: Folder of the dataset, which must not exist.
        episodes: Episodes by the name of their task. An episode is as in `write_demonstrations`,
            with ``action``, what was executed, and ``success``, whether the last action solved the
            task.
        scene: The robot, or its name.

    Raises:
        ValueError: As from `write_demonstrations`, or if an episode lacks actions or success.
        OSError: If there is not enough disk space, or the folder cannot be written.

    Examples:
        >>> frames, action = np.zeros((3, 32, 64, 3), np.uint8), np.zeros((2, 4))
        >>> failed = {"pixels": frames, "action": action, "success": False}
        >>> path = getfixture("tmp_path") / "log"
        >>> write_logged_episodes(path, {"grasp_glass": [failed]}, scene="nico")
    """
    settings = {"held_out_per_task": 0, "spread": 1.0, "logged": True}
    _write(Path(path), find_scene(scene), episodes, settings)


def _write(path: Path, scene: Scene, episodes: Episodes, settings: Mapping[str, Any]) -> TensorDict:
    """Check and write episodes, in the order of their tasks."""
    scene.check_tasks([*episodes])
    held_out_per_task = settings["held_out_per_task"]
    _check_counts(episodes, held_out_per_task)
    keys, lengths = _check_episodes(scene, episodes, logged="logged" in settings)
    meta = {
        **layout_of(scene, keys, max(lengths) - 1),
        "tasks": [*episodes],
        "rows": len(lengths),
        **settings,
    }
    with new_folder(path) as folder:
        dataset = make_dataset(folder, meta)
        row = 0
        for task, (name, some) in enumerate(episodes.items()):
            n_shown = len(some) - held_out_per_task
            for number in range(len(some)):
                episode = some[number]
                with _naming(name, number):
                    if _check_episode(scene, episode) != lengths[row]:
                        raise ValueError("is another one when read again")
                fill_row(dataset, row, episode, task, number < n_shown)
                row += 1
        write_json(folder / META, {**meta, "checksum": checksum_of(dataset)})
    return dataset


def resize_frames(pixels: NDArray[np.uint8], frame_shape: Sequence[int]) -> NDArray[np.uint8]:
    """Return frames uint8 ``[T, H, W, 3]`` in another height and width, by area averaging.

    A pixel is the rounded mean of the pixels below it. Height and width are scaled independently:
    crop the frames before, if their ratio is not to change.

    Raises:
        ValueError: If the frames are not uint8 ``[T, H, W, 3]``, or a side is below 1.

    Examples:
        >>> resize_frames(np.full((1, 64, 64, 3), 7, np.uint8), (32, 64)).shape
        (1, 32, 64, 3)
    """
    pixels = np.asarray(pixels)
    _check_pixels(pixels, least=0)
    height, width = as_shape([*frame_shape], "frame_shape")
    frames = torch.from_numpy(pixels.copy()).permute(0, 3, 1, 2)
    parts = [
        torch.nn.functional.interpolate(part.float(), (height, width), mode="area").round()
        for part in frames.split(64)
    ]
    return torch.cat(parts).to(torch.uint8).permute(0, 2, 3, 1).contiguous().numpy()


def _check_counts(episodes: Episodes, held_out_per_task: int) -> None:
    if not episodes:
        raise ValueError("there are no episodes: give some of at least one task")
    if held_out_per_task < 0:
        raise ValueError(f"held_out_per_task must be at least 0, got {held_out_per_task}")
    for name, some in episodes.items():
        if not hasattr(some, "__len__"):
            raise ValueError(f"{name!r} has a {type(some).__name__}: give a list of its episodes")
        if not len(some):
            raise ValueError(f"there is no episode of {name!r}: add some, or leave the task out")
        if len(some) <= held_out_per_task:
            raise ValueError(
                f"{name!r} has {len(some)} episodes, too few to hold out {held_out_per_task}: "
                "lower held_out_per_task, or add episodes"
            )


def _check_episodes(
    scene: Scene, episodes: Episodes, *, logged: bool
) -> tuple[set[str], list[int]]:
    """Return the keys of all episodes and the number of frames of each; warn of doubtful ones."""
    keys: set[str] | None = None
    lengths, known, doubtful = [], set[bytes](), dict[str, list[str]]()
    for name, some in episodes.items():
        if isinstance(some, Mapping):
            raise ValueError(f"{name!r} has one mapping: give a list of episodes, a mapping each")
        for number in range(len(some)):
            episode = some[number]
            with _naming(name, number):
                _check_keys(episode, keys, logged)
                lengths.append(_check_episode(scene, episode))
            keys = set(episode)
            for doubt in _doubts(scene, episode, known):
                doubtful.setdefault(doubt, []).append(f"{number} of {name!r}")
    for doubt, which in doubtful.items():
        share = f"{len(which)} of {len(lengths)} episodes"
        warnings.warn(f"{share}, such as {which[0]}, {doubt}", stacklevel=4)
    return keys or set(), lengths


@contextlib.contextmanager
def _naming(name: str, number: int) -> Iterator[None]:
    try:
        yield
    except ValueError as error:
        raise ValueError(f"episode {number} of {name!r} {error}") from None


def _doubts(scene: Scene, episode: Mapping[str, Any], known: set[bytes]) -> Iterator[str]:
    """Yield what is doubtful about an episode, given the digests of the frames of earlier ones."""
    pixels = np.ascontiguousarray(episode["pixels"])
    repeated = (pixels[1:] == pixels[:-1]).all((1, 2, 3))
    if repeated.all():
        yield "show one frame throughout: did the camera stand still?"
    elif pixels.max() <= 1:
        yield "have no color above 1: are they fractions, which uint8 cuts off?"
    content = hashlib.sha256(pixels.data).digest()
    if content in known:
        yield "have the frames of an earlier one: give each once"
    known.add(content)
    if len(pixels) > scene.max_steps + 1:
        yield f"have more steps than the scene's {scene.max_steps}: at another rate, or not cut?"
    if len(repeated) > _IDLE and (repeated[1:] != repeated[:-1]).all():
        yield "repeat every other frame: is the camera slower than the actions?"
    for end, still in ("begin", repeated), ("end", repeated[::-1]):
        if still[:_IDLE].all() and not still.all():
            yield f"{end} with {_IDLE} or more steps that change nothing: cut them off"
    joints = scene.joints if "joints" in episode else None
    if joints is not None and joints.far(np.asarray(episode["joints"])):
        yield "have joints farther from the scene's center than its unit allows: in another unit?"


def _check_episode(scene: Scene, episode: Mapping[str, Any]) -> int:
    """Return the number of frames of an episode, checked as `write_demonstrations` says."""
    pixels = np.asarray(episode["pixels"])
    _check_pixels(pixels, least=2)
    length, *size = pixels.shape[:3]
    if size != [*scene.frame_shape]:
        height, width = scene.frame_shape
        raise ValueError(
            f"has frames of {size[0]} x {size[1]} pixels, the scene {scene.name!r} of {height} x "
            f"{width}: resize them first, for example with resize_frames"
        )
    shapes = {"action": (length - 1, scene.action_size)}
    for key, columns in (("state", scene.state), ("joints", scene.joints)):
        if columns is not None:
            shapes[key] = (length, columns.size)
        elif key in episode:
            raise ValueError(f"has {key}, but the scene {scene.name!r} has none: omit them")
    for key in shapes.keys() & episode.keys():
        values, shape = np.asarray(episode[key]), shapes[key]
        if values.dtype.kind not in "fiu" or values.shape != shape:
            raise ValueError(
                f"has the {key} {values.dtype} {[*values.shape]}: give {[*shape]} numbers for its "
                f"{length} frames"
            )
        with np.errstate(over="ignore"):
            finite = np.isfinite(values.astype(np.float32)).all()  # as they are stored
        if not finite:
            raise ValueError(f"has numbers in {key} that are not finite: leave the episode out")
    largest = np.abs(np.asarray(episode.get("action", 0), np.float32)).max()
    if largest > 1:
        raise ValueError(f"has an action of size {largest!s}: scale actions to [-1, 1]")
    return length


def _check_keys(episode: object, keys: set[str] | None, logged: bool) -> None:
    if not isinstance(episode, Mapping):
        raise ValueError(
            f"is missing ({type(episode).__name__}): give its 'pixels', or leave the episode out"
        )
    names = ", ".join(repr(key) for key in episode) or "nothing"
    least = {"pixels", "action", "success"} if logged else {"pixels"}
    if not least <= {*episode} <= {*_KEYS, *least}:
        wanted = ", ".join(repr(key) for key in (*_KEYS, "success") if key in least)
        known = ", ".join(repr(key) for key in _KEYS if key not in least)
        raise ValueError(f"has {names}: give {wanted}, and if known {known}")
    if logged and type(episode["success"]) not in (bool, np.bool_):
        raise ValueError(f"has the success {episode['success']!r}: give True or False")
    if keys not in (None, {*episode}):
        raise ValueError(
            f"has {names}, those before it {', '.join(map(repr, sorted(keys)))}: give actions, "
            "joints and states of all episodes or of none"
        )


def _check_pixels(pixels: NDArray[Any], least: int) -> None:
    """Raise ``ValueError`` unless frames are colors of 8 bits; others mean what nobody knows."""
    shape = pixels.shape
    if pixels.dtype != np.uint8 or len(shape) != 4 or shape[-1] != 3 or shape[0] < least:
        raise ValueError(
            f"has pixels {pixels.dtype} {[*shape]}: give uint8 [T, H, W, 3] (0 to 255)"
            + (f", at least {least} frames" if least else "")
        )
