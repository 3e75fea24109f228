"""Demonstrations: record, store, load; and the bank of their embeddings."""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import tyro
from dm_env import TimeStep
from tensordict import MemoryMappedTensor, TensorDict
from torch import Tensor

from bgpo_trl.folders import make_folder
from bgpo_trl.progress import progress_bar
from bgpo_trl.tensor_file import load_tensors, save_tensors
from suites import nico
from suites.nico.base import STATE_SIZE, Environment
from suites.nico.demonstrator import Demonstrator
from suites.nico.rendering import FRAME_HEIGHT, FRAME_WIDTH, FrameRenderer

MAX_STEPS = 50
_META = "dataset.json"
_REMEDY = "record it anew with `python -m bgpo_trl.demonstrations PATH`"


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
    progress: bool = True,
) -> TensorDict:
    """Records successful demonstrations of each task; continues a recording that was interrupted.

    Row ``i`` is determined by ``seed`` and ``i`` alone, so an interrupted recording ends the same.

    With ``play`` it records what the robot sees when it plays instead: it follows a demonstration
    for a while, up to 30 steps, then moves at random until the 50 steps are over. A robot that
    learns by trial and error sees much that no demonstration shows.

    Args:
        path: Folder of the dataset; made if missing.
        tasks: Tasks to demonstrate, in the order of their labels.
        per_task: Demonstrations of each task (1,200 in Sec. IV-B).
        held_out_per_task: How many of those are held out for test episodes.
        play: Record play in place of demonstrations.
        seed: Seed of starts and of the demonstrator's noise.
        progress: Whether to show a progress bar.

    Returns:
        A memory-mapped TensorDict ``[N]`` with ``pixels`` uint8 ``[N, 51, 32, 64, 3]``, ``state``
        ``[N, 51, 16]``, ``action`` ``[N, 50, 4]``, ``length`` int64 ``[N]`` (frames, one more than
        actions), ``task`` int64 ``[N]``, ``train`` bool ``[N]`` (False: held out) and ``seed``
        int64 ``[N]``. What lies beyond the length is zero.

    Raises:
        ValueError: If an argument is wrong, or there is another recording at that path.
        OSError: If the disk has no room for it.
        RuntimeError: If there is no OpenGL to render with.
    """
    nico.check_tasks(tasks)
    if not tasks:
        raise ValueError("name at least one of the tasks")
    if seed < 0:
        raise ValueError(f"seed must be at least 0, got {seed}")
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
    # Before anything is written: without OpenGL there is nothing to record.
    physics = nico.Physics.from_xml_string(nico.scene_xml())
    shared = {"physics": physics, "renderer": FrameRenderer(physics.model.ptr)}
    environments = [nico.load(task, observation="both", **shared) for task in tasks]
    if started:
        dataset = _open(path, per_task * len(tasks))
    else:
        dataset = _make(path, per_task * len(tasks))
        _write_meta(path, wanted)
    missing = torch.nonzero(dataset["length"] == 0).flatten().tolist()
    perform = _play if play else _demonstrate
    described = "record play" if play else "record demonstrations"
    n = len(dataset)
    for row in progress_bar(
        described, missing, shown=progress, total=n, initial=n - len(missing), unit="episode"
    ):
        task = row // per_task
        episode = perform(environments[task], seed, row)
        n_frames = len(episode["pixels"])
        for key in ("pixels", "state", "action"):
            dataset[key][row, : len(episode[key])] = torch.from_numpy(episode[key])
        dataset["task"][row] = task
        dataset["seed"][row] = seed
        dataset["train"][row] = row % per_task < per_task - held_out_per_task
        # Written last: a row without a length is recorded again.
        dataset["length"][row] = n_frames
    _write_meta(path, {**wanted, "checksum": _checksum(dataset)})
    return dataset


def _demonstrate(env: Environment, seed: int, row: int) -> dict[str, np.ndarray]:
    """Returns the first success among attempts whose seeds follow from seed and row."""
    sequence = np.random.SeedSequence([seed, row])
    while True:
        start, noise = (int(child.generate_state(1)[0]) for child in sequence.spawn(2))
        demonstrator = Demonstrator(env, seed=noise)
        episode, reward = _perform(env, start, demonstrator, demonstrator)
        if reward:
            return episode


def _play(env: Environment, seed: int, row: int) -> dict[str, np.ndarray]:
    """Returns an episode that leaves its demonstration for random movements, jerky or smooth."""
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
    """Returns an episode from the start with that seed, and its last reward."""
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
        raise ValueError(f"{path} is no dataset of demonstrations; {_REMEDY}") from None
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
    if size > free:  # Writing to a memory map on a full disk kills the process.
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
    # Not TensorDict.load_memmap: its meta.json, which the checksum does not cover, could have the
    # bytes read as something else.
    tensors = {
        key: MemoryMappedTensor.from_filename(
            path / f"{key}.memmap", dtype=value.dtype, shape=value.shape
        )
        for key, value in expected.items()
    }
    return TensorDict(tensors, [n])


def load_demonstrations(path: str | Path, *, verify: bool = True) -> TensorDict:
    """Opens a recorded dataset, memory-mapped.

    Args:
        path: Folder of the dataset.
        verify: Whether to compare the checksum, which reads all of it.

    Returns:
        What `record_demonstrations` returned.

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


@dataclass(frozen=True)
class DemonstrationBank:
    """Embedded demonstrations: all that BGPO needs of them once the encoders are trained.

    Attributes:
        embedding: phi, float32 ``[N, 32]``.
        task: Labels, int64 ``[N]``; for the draw of an episode's task and for evaluation.
        train: Bool ``[N]``; False for demonstrations held out for test episodes.
        tasks: Names of the tasks, in the order of their labels.

    Raises:
        ValueError: If a label has no name.
    """

    embedding: Tensor
    task: Tensor
    train: Tensor
    tasks: tuple[str, ...] = nico.ALL_TASKS

    def __post_init__(self) -> None:
        unknown = self.task[(self.task < 0) | (self.task >= len(self.tasks))]
        if len(unknown):
            raise ValueError(
                f"there is a demonstration of task {int(unknown[0])}, but tasks names only "
                f"{len(self.tasks)}: {', '.join(self.tasks)}"
            )

    def seen(self) -> DemonstrationBank:
        """Returns the demonstrations for training episodes."""
        return self._select(self.train)

    def held_out(self) -> DemonstrationBank:
        """Returns the demonstrations for test episodes."""
        return self._select(~self.train)

    def of_task(self, task: int) -> DemonstrationBank:
        """Returns the demonstrations of one task."""
        return self._select(self.task == task)

    def for_tasks(self, tasks: Sequence[str]) -> DemonstrationBank:
        """Returns the demonstrations of some tasks, labeled by their places among these.

        Args:
            tasks: Names, in the order of the labels wanted.

        Raises:
            ValueError: If there is no demonstration of one of them.
        """
        missing = [name for name in tasks if name not in self.tasks]
        if missing:
            raise ValueError(
                f"the bank has no demonstration of {missing[0]!r}, only of "
                f"{', '.join(self.tasks)}: record and embed some (docs/extending.md)"
            )
        label = torch.tensor([tasks.index(n) if n in tasks else -1 for n in self.tasks])
        kept = self._select(label[self.task] >= 0)
        return replace(kept, task=label[kept.task], tasks=tuple(tasks))

    def __add__(self, other: DemonstrationBank) -> DemonstrationBank:
        """Returns the demonstrations of both; tasks that only the other has come last."""
        tasks = tuple(dict.fromkeys((*self.tasks, *other.tasks)))
        label = torch.tensor([tasks.index(name) for name in other.tasks])
        return DemonstrationBank(
            torch.cat([self.embedding, other.embedding]),
            torch.cat([self.task, label[other.task]]),
            torch.cat([self.train, other.train]),
            tasks,
        )

    def _select(self, rows: Tensor) -> DemonstrationBank:
        return replace(
            self, embedding=self.embedding[rows], task=self.task[rows], train=self.train[rows]
        )

    def save(self, path: str | Path, *, encoder_id: str) -> None:
        """Writes the bank as safetensors, with the scene version and the encoders' identity.

        Raises:
            OSError: If the file cannot be written; one that was there stays.
        """
        tensors = {"embedding": self.embedding, "task": self.task, "train": self.train}
        meta = {
            "scene_version": nico.scene_version(),
            "encoder_id": encoder_id,
            "tasks": ",".join(self.tasks),
        }
        save_tensors(path, tensors, meta)

    @classmethod
    def load(cls, path: str | Path, *, encoder_id: str) -> DemonstrationBank:
        """Reads a bank.

        Raises:
            ValueError: If it is missing, damaged, or made in another scene or by other encoders.
        """
        wanted = {"scene_version": nico.scene_version(), "encoder_id": encoder_id}
        remedy = "make it anew with `--train-encoders`"
        try:
            tensors, meta = load_tensors(path)
            if not meta.get("tasks"):
                raise ValueError("it does not say which tasks it is about")
            bank = cls(**tensors, tasks=tuple(meta["tasks"].split(",")))
        except FileNotFoundError:
            raise ValueError(f"there is no demonstration bank at {path}; {remedy}") from None
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path} is damaged or no bank ({error}); {remedy}") from None
        embedding, task, train = bank.embedding, bank.task, bank.train
        if not (
            embedding.ndim == 2
            and task.shape == train.shape == embedding.shape[:1]
            and (embedding.dtype, task.dtype, train.dtype)
            == (torch.float32, torch.int64, torch.bool)
            and embedding.isfinite().all()
        ):
            raise ValueError(f"{path} is damaged (wrong shapes, or NaN); {remedy}")
        found = {key: meta.get(key) for key in wanted}
        if found != wanted:
            raise ValueError(f"{path} belongs to {found}, but needed is {wanted}; {remedy}")
        return bank


def main(
    path: tyro.conf.Positional[Path],
    per_task: int = 1_200,
    held_out_per_task: int = 200,
    play: bool = False,
    seed: int = 0,
) -> None:
    """Records the dataset of demonstrations; the same command continues an interrupted one.

    Args:
        path: Folder of the dataset.
        per_task: Demonstrations of each task.
        held_out_per_task: How many of those are held out for test episodes.
        play: Record how the robot plays at random in place of demonstrations.
        seed: Seed of starts and noise.
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
