"""Recorded demonstrations (frames, states, actions): record, store and load them."""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
import tyro
from dm_env import TimeStep
from tensordict import MemoryMappedTensor, TensorDict

from bgpo_trl.files.folders import make_folder
from bgpo_trl.files.progress import progress_bar
from suites import nico
from suites.nico.base import STATE_SIZE, Environment
from suites.nico.demonstrator import Demonstrator
from suites.nico.rendering import FRAME_HEIGHT, FRAME_WIDTH, FrameRenderer

MAX_STEPS = 50
_META = "dataset.json"
_REMEDY = "record it again with `python -m bgpo_trl.data.recording PATH`"


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


def _checksum(dataset: TensorDict) -> str:
    digest = hashlib.sha256()
    for _, tensor in sorted(dataset.items()):
        for rows in tensor.split(256):
            digest.update(rows.numpy().data)
    return digest.hexdigest()


def record_demonstrations(
    path: str | Path,
    *,
    tasks: Sequence[str] = nico.ALL_TASKS,
    per_task: int = 1_200,
    held_out_per_task: int = 200,
    play: bool = False,
    seed: int = 0,
    attempts: int = 100,
    progress: bool = True,
) -> TensorDict:
    """Record successful demonstrations of each task, or resume an interrupted recording.

    Row ``i`` depends on ``seed`` and ``i`` alone, so a resumed recording gives the same dataset.

    With ``play``, record play instead: follow a demonstration for up to 30 steps, then act at
    random until step 50. Trial and error visits states that no demonstration shows.

    Args:
        path: Folder of the dataset; made if missing.
        tasks: Tasks to demonstrate, in the order of their labels.
        per_task: Demonstrations of each task (1,200 in Sec. IV-B).
        held_out_per_task: How many of those are held out for test episodes.
        play: Record play instead of demonstrations.
        seed: Seed of the start states and of the demonstrator's noise.
        attempts: Consecutive failures of a demonstrator after which recording stops.
        progress: Whether to show a progress bar.

    Returns:
        A memory-mapped TensorDict ``[N]`` with ``pixels`` uint8 ``[N, 51, 32, 64, 3]``, ``state``
        ``[N, 51, 16]``, ``action`` ``[N, 50, 4]``, ``length`` int64 ``[N]`` (frames, one more than
        actions), ``task`` int64 ``[N]``, ``train`` bool ``[N]`` (``False``: held out) and ``seed``
        int64 ``[N]``; zero beyond the length.

    Raises:
        ValueError: If an argument is invalid, or ``path`` holds another recording.
        OSError: If there is not enough disk space.
        RuntimeError: If there is no OpenGL to render with, or a demonstrator fails too often;
            earlier rows are kept.
    """
    nico.check_tasks(tasks)
    if not tasks:
        raise ValueError("name at least one of the tasks")
    if seed < 0:
        raise ValueError(f"seed must be at least 0, got {seed}")
    if attempts < 1:
        raise ValueError(f"attempts must be at least 1, got {attempts}")
    if not 0 <= held_out_per_task < per_task:
        raise ValueError(
            f"held_out_per_task is {held_out_per_task}: it must be less than per_task, {per_task}"
        )
    path = Path(path)
    wanted = {
        "scene_version": nico.scene_version(),
        "tasks": list(tasks),
        "per_task": per_task,
        "held_out_per_task": held_out_per_task,
        "seed": seed,
        **({"play": True} if play else {}),
    }
    started = (path / _META).exists()
    if started:
        meta = _read_meta(path)
        found = {key: meta.get(key) for key in {**wanted, **meta} if key != "checksum"}
        if found != wanted:
            raise ValueError(
                f"{path} holds another recording ({found}); choose another folder or remove it"
            )
        if meta.get("checksum"):
            return load_demonstrations(path)
    # The renderer comes first, so that a machine without OpenGL fails before writing anything.
    physics = nico.Physics.from_xml_string(nico.scene_xml())
    shared = {"physics": physics, "renderer": FrameRenderer(physics.model.ptr)}
    environments = [nico.load(task, observation="both", **shared) for task in tasks]
    if started:
        dataset = _open(path, per_task * len(tasks))
    else:
        dataset = _make(path, per_task * len(tasks))
        _write_meta(path, wanted)
    missing = torch.nonzero(dataset["length"] == 0).flatten().tolist()
    tried, done = [0] * len(tasks), [0] * len(tasks)
    described = "record play" if play else "record demonstrations"
    n = len(dataset)
    for row in progress_bar(
        described, missing, shown=progress, total=n, initial=n - len(missing), unit="episode"
    ):
        task = row // per_task
        if play:
            episode = _play(environments[task], seed, row)
        else:
            episode, n = _demonstrate(environments[task], seed, row, attempts)
            tried[task] += n
            if episode is None:
                raise RuntimeError(
                    f"the demonstrator of {tasks[task]!r} failed {attempts} times in a row "
                    f"({done[task]} of {tried[task]} attempts succeeded, "
                    f"{done[task] / tried[task]:.0%}): fix its demonstration(), or raise attempts"
                )
            done[task] += 1
        n_frames = len(episode["pixels"])
        for key in ("pixels", "state", "action"):
            dataset[key][row, : len(episode[key])] = torch.from_numpy(episode[key])
        dataset["task"][row] = task
        dataset["seed"][row] = seed
        dataset["train"][row] = row % per_task < per_task - held_out_per_task
        # Written last, since a row whose length is 0 is recorded again.
        dataset["length"][row] = n_frames
    _write_meta(path, {**wanted, "checksum": _checksum(dataset)})
    return dataset


def _demonstrate(
    env: Environment, seed: int, row: int, attempts: int
) -> tuple[dict[str, np.ndarray] | None, int]:
    """Return the first success, or ``None``, and the number of attempts."""
    sequence = np.random.SeedSequence([seed, row])
    for attempt in range(1, attempts + 1):
        start, noise = (int(child.generate_state(1)[0]) for child in sequence.spawn(2))
        demonstrator = Demonstrator(env, seed=noise)
        episode, reward = _perform(env, start, demonstrator, demonstrator)
        if reward:
            return episode, attempt
    return None, attempts


def _play(env: Environment, seed: int, row: int) -> dict[str, np.ndarray]:
    """Return an episode that follows a demonstration, then moves at random, jerkily or smoothly."""
    rng = np.random.default_rng([seed, row, 1])
    start, noise = (int(value) for value in rng.integers(2**32, size=2))
    demonstrator = Demonstrator(env, seed=noise)
    n_followed, persistence, spread = rng.integers(31), rng.uniform(0, 0.9), rng.uniform(0.2, 0.8)
    movement, steps = rng.standard_normal(4), 0

    def act(timestep: TimeStep) -> np.ndarray:
        nonlocal movement, steps
        steps += 1
        if steps <= n_followed:
            return demonstrator(timestep)
        movement = persistence * movement + (1 - persistence**2) ** 0.5 * rng.standard_normal(4)
        return np.clip(spread * movement, -1.0, 1.0)

    return _perform(env, start, demonstrator, act)[0]


def _perform(
    env: Environment,
    start: int,
    demonstrator: Demonstrator,
    policy: Callable[[TimeStep], np.ndarray],
) -> tuple[dict[str, np.ndarray], float]:
    """Return an episode from the start with seed ``start``, and its last reward."""
    env.task.random.seed(start)
    timestep = env.reset()
    demonstrator.reset()
    observations, actions = [timestep.observation], []
    while not timestep.last():
        actions.append(policy(timestep))
        timestep = env.step(actions[-1])
        observations.append(timestep.observation)
    episode = {
        "pixels": np.stack([o["pixels"] for o in observations]),
        "state": np.stack([o["privileged_state"] for o in observations]),
        "action": np.stack(actions),
    }
    return episode, float(timestep.reward)


def _write_meta(path: Path, meta: dict) -> None:
    temporary = path / (_META + ".tmp")
    temporary.write_text(json.dumps(meta, indent=2))
    temporary.replace(path / _META)


def _read_meta(path: Path) -> dict:
    try:
        meta = json.loads((path / _META).read_text())
    except OSError:
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


def _make(path: Path, n: int) -> TensorDict:
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


def _open(path: Path, n: int) -> TensorDict:
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


def load_demonstrations(path: str | Path, *, verify: bool = True) -> TensorDict:
    """Open a recorded dataset, memory-mapped.

    Args:
        path: Folder of the dataset.
        verify: Whether to verify the checksum, which reads the whole dataset.

    Returns:
        The dataset as returned by `record_demonstrations`.

    Raises:
        ValueError: If it is missing, incomplete, damaged or of another scene version.
    """
    path = Path(path)
    meta = _read_meta(path)
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
    dataset = _open(path, meta["per_task"] * len(meta["tasks"]))
    if verify and _checksum(dataset) != meta["checksum"]:
        raise ValueError(f"{path} is damaged (checksum differs); remove it and {_REMEDY}")
    return dataset


def main(
    path: tyro.conf.Positional[Path],
    per_task: int = 1_200,
    held_out_per_task: int = 200,
    play: bool = False,
    seed: int = 0,
) -> None:
    """Record the dataset of demonstrations; the same command resumes an interrupted recording.

    Args:
        path: Folder of the dataset.
        per_task: Demonstrations of each task.
        held_out_per_task: How many of those are held out for test episodes.
        play: Record random play instead of demonstrations.
        seed: Seed of the start states and of the noise.
    """
    record_demonstrations(
        path, per_task=per_task, held_out_per_task=held_out_per_task, play=play, seed=seed
    )


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except (ValueError, OSError, RuntimeError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit("interrupted: the same command continues the recording")
