"""Test episodes of finished runs, and the same episodes played by scripted policies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from dm_env import TimeStep
from numpy.typing import NDArray

from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.envs import NicoEnv
from bgpo_trl.evaluation import Evaluator, Snapshot
from bgpo_trl.files.checkpoint import has_checkpoint
from bgpo_trl.policy import LoadedRun, TrainedPolicy, load_all_seeds
from bgpo_trl.training import Trainer
from bgpo_trl.transforms import TaskSchedule
from suites import nico
from suites.nico.base import Environment

Actor = Callable[[TimeStep], NDArray]
"""Scripted policy: maps a time step to an action ``[4]``."""


def load_blocks(run: Path) -> list[LoadedRun]:
    """Load all seeds of a run: the run itself, or the blocks of which it was merged.

    Raises:
        ValueError: As for `load_all_seeds`.
    """
    blocks = sorted(path for path in run.glob("seeds-*") if has_checkpoint(path / "checkpoint"))
    if not blocks or has_checkpoint(run / "checkpoint"):
        blocks = [run]
    return [load_all_seeds(block) for block in blocks]


def evaluator_of(
    run: LoadedRun | Trainer | TrainedPolicy,
    bank: DemonstrationBank,
    episodes: int,
    *,
    starts: tuple[int, ...] | None = None,
    make_env: Callable[..., NicoEnv] | None = None,
) -> Evaluator:
    """Return an evaluator of the tasks of a run.

    Args:
        run: The run.
        bank: Demonstrations to show.
        episodes: Test episodes of each task and seed.
        starts: Episode from which each task is presented; by default all are.
        make_env: Constructor of the simulation, `NicoEnv` if None.
    """
    config = run.config
    return Evaluator(
        config.algorithm,
        seeds=config.seeds,
        schedule=TaskSchedule((0,) * len(config.tasks) if starts is None else starts),
        episodes=episodes,
        bank=bank,
        encoders=run.encoders,
        spread=config.spread,
        make_env=make_env,
    )


def snapshots_of(run: LoadedRun | Trainer, evaluator: Evaluator, number: int) -> list[Snapshot]:
    """Return the trained policy of each seed, conditioned for evaluation ``number``."""
    return [
        evaluator.snapshot(run.algorithm, index, number, episode=run.config.episodes)
        for index in range(len(run.config.seeds))
    ]


@dataclass(frozen=True)
class Episode:
    """First and last state of a test episode.

    Attributes:
        task: Name of the task.
        seed: Seed of the run whose start it was.
        success: Whether it ended with success.
        start: State of the simulation at the start, as from ``physics.get_state()``.
        end: The same at the end.
    """

    task: str
    seed: int
    success: bool
    start: NDArray
    end: NDArray


def play(
    tasks: tuple[str, ...],
    starts: NDArray[np.int64],
    seed: int,
    make_actor: Callable[[Environment, int], Actor],
    max_steps: int,
    spread: float = 1.0,
) -> list[Episode]:
    """Play an episode from each start with a scripted policy.

    Args:
        tasks: Names of the tasks.
        starts: Seeds of the starts, ``[T, M]``, as from `start_seeds`.
        seed: Seed of the run whose starts they are.
        make_actor: Called at each start with the environment and the start's seed.
        max_steps: Longest episode.
        spread: Share of the whole range of start states.
    """
    physics, episodes = nico.Physics.from_xml_string(nico.scene_xml()), []
    for task, of_task in zip(tasks, starts.tolist(), strict=True):
        for start_seed in of_task:
            env = nico.load(
                task,
                seed=start_seed,
                spread=spread,
                observation="state",
                time_limit=float("inf"),
                physics=physics,
            )
            timestep = env.reset()
            start, act = physics.get_state(), make_actor(env, start_seed)
            for _ in range(max_steps):
                timestep = env.step(act(timestep))
                if timestep.last():
                    break
            episodes.append(Episode(task, seed, timestep.last(), start, physics.get_state()))
    return episodes


def random_actions(env: Environment, seed: int) -> Actor:
    """Return a policy of uniformly random actions."""
    del env
    random = np.random.default_rng(seed)
    return lambda _: random.uniform(-1.0, 1.0, 4)
