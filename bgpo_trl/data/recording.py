"""Record demonstrations (frames, states, actions) as a dataset."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import tyro
from dm_env import TimeStep
from tensordict import TensorDict

from bgpo_trl.data.dataset import (
    checksum_of,
    is_dataset,
    load_demonstrations,
    make_dataset,
    open_dataset,
    read_meta,
    write_meta,
)
from bgpo_trl.files.progress import progress_bar
from bgpo_trl.plugins import import_plugin
from suites import nico
from suites.nico.base import Environment
from suites.nico.demonstrator import Demonstrator
from suites.nico.rendering import FrameRenderer


def record_demonstrations(
    path: str | Path,
    *,
    tasks: Sequence[str] = nico.PAPER_TASKS,
    per_task: int = 1_200,
    held_out_per_task: int = 200,
    play: bool = False,
    spread: float = 1.0,
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
        spread: Share of the whole range of start states, see `suites.nico.load`.
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
    wanted = _settings(tasks, per_task, held_out_per_task, play, spread, seed, attempts)
    path = Path(path)
    started = is_dataset(path)
    if started and _is_complete(path, wanted):
        return load_demonstrations(path)
    # The renderer comes first, so that a machine without OpenGL fails before writing anything.
    environments = _environments(tasks, spread)
    n = per_task * len(tasks)
    dataset = open_dataset(path, n) if started else make_dataset(path, n)
    if not started:
        write_meta(path, wanted)
    _record_rows(dataset, environments, wanted, attempts, progress)
    write_meta(path, {**wanted, "checksum": checksum_of(dataset)})
    return dataset


def _settings(
    tasks: Sequence[str],
    per_task: int,
    held_out_per_task: int,
    play: bool,
    spread: float,
    seed: int,
    attempts: int,
) -> dict[str, Any]:
    """Check the arguments and return the settings that identify a recording."""
    nico.check_tasks(tasks)
    nico.check_spread(spread)
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
    return {
        "scene_version": nico.scene_version(),
        "tasks": list(tasks),
        "per_task": per_task,
        "held_out_per_task": held_out_per_task,
        "spread": float(spread),
        "seed": seed,
        **({"play": True} if play else {}),
    }


def _is_complete(path: Path, wanted: Mapping[str, Any]) -> bool:
    """Return whether a recording was completed; raise ``ValueError`` if it has other settings."""
    meta = read_meta(path)
    found = {key: meta.get(key) for key in {**wanted, **meta} if key != "checksum"}
    if found != wanted:
        raise ValueError(
            f"{path} holds another recording ({found}); choose another folder or remove it"
        )
    return bool(meta.get("checksum"))


def _environments(tasks: Sequence[str], spread: float) -> list[Environment]:
    """Return an environment of each task, with one simulation and renderer for all."""
    physics = nico.Physics.from_xml_string(nico.scene_xml())
    shared = {"physics": physics, "renderer": FrameRenderer(physics.model.ptr)}
    return [nico.load(task, spread=spread, observation="both", **shared) for task in tasks]


def _record_rows(
    dataset: TensorDict,
    environments: Sequence[Environment],
    wanted: Mapping[str, Any],
    attempts: int,
    progress: bool,
) -> None:
    tasks, per_task, seed = wanted["tasks"], wanted["per_task"], wanted["seed"]
    play, n_shown = "play" in wanted, per_task - wanted["held_out_per_task"]
    missing = torch.nonzero(dataset["length"] == 0).flatten().tolist()
    tried, done = [0] * len(tasks), [0] * len(tasks)
    bar = progress_bar(
        "record play" if play else "record demonstrations",
        missing,
        shown=progress,
        total=len(dataset),
        initial=len(dataset) - len(missing),
        unit="episode",
    )
    for row in bar:
        task = row // per_task
        if play:
            episode = _play(environments[task], seed, row)
        else:
            episode, tries = _demonstrate(environments[task], seed, row, attempts)
            tried[task] += tries
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
        dataset["train"][row] = row % per_task < n_shown
        # Written last, since a row whose length is 0 is recorded again.
        dataset["length"][row] = n_frames


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


def main(
    path: tyro.conf.Positional[Path],
    tasks: tuple[str, ...] = nico.PAPER_TASKS,
    module: Annotated[str | None, tyro.conf.arg(name="import")] = None,
    per_task: int = 1_200,
    held_out_per_task: int = 200,
    play: bool = False,
    spread: float = 1.0,
    seed: int = 0,
) -> None:
    """Record the dataset of demonstrations; the same command resumes an interrupted recording.

    Args:
        path: Folder of the dataset.
        tasks: Tasks to demonstrate.
        module: Module that adds tasks with nico.add_task, imported first; here or installed.
        per_task: Demonstrations of each task.
        held_out_per_task: How many of those are held out for test episodes.
        play: Record random play instead of demonstrations.
        spread: Share of the whole range of start states.
        seed: Seed of the start states and of the noise.
    """
    import_plugin(module)
    record_demonstrations(
        path,
        tasks=tasks,
        per_task=per_task,
        held_out_per_task=held_out_per_task,
        play=play,
        spread=spread,
        seed=seed,
    )


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except (ValueError, OSError, RuntimeError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit("interrupted: the same command continues the recording")
