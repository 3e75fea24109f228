"""Arguments, loading, and episodes of scripted policies, for all studies of trained runs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import tyro
from dm_env import TimeStep
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from numpy.typing import NDArray

from bgpo_trl.experiments.arguments import ImportArguments
from bgpo_trl.figures.style import add_legend, style_axes
from bgpo_trl.files.checkpoint import has_checkpoint
from bgpo_trl.files.writing import make_folder, write_json
from bgpo_trl.policy import LoadedRun, load_all_seeds
from bgpo_trl.runs.provenance import command, write_table
from suites import nico
from suites.nico.base import Environment

Actor = Callable[[TimeStep], NDArray]
"""Scripted policy: maps a time step to an action ``[4]``."""


@dataclass(frozen=True, kw_only=True)
class TrainedArguments(ImportArguments):
    """Tests of the policies of a run."""

    run: tyro.conf.Positional[Path]
    """Run directory."""
    episodes: int = 20
    """Test episodes per task and seed, in each condition."""
    out: Path | None = None
    """Folder to write to; the run directory by default."""

    def __post_init__(self) -> None:
        if self.episodes < 1:
            raise ValueError(f"--episodes must be at least 1, got {self.episodes}")


def load_blocks(run: Path, *, of_nico: bool = False) -> list[LoadedRun]:
    """Load all seeds of a run: the run itself, or the runs of single seeds in its folder.

    Raises:
        ValueError: As for `load_all_seeds`, or if the run is not ``of_nico`` and has to be.
    """
    paths = sorted(path for path in run.glob("seeds-*") if has_checkpoint(path / "checkpoint"))
    if not paths or has_checkpoint(run / "checkpoint"):
        paths = [run]
    blocks = [load_all_seeds(path) for path in paths]
    scene = blocks[0].config.scene
    if of_nico and scene != "nico":
        raise ValueError(f"{run} is a run of the scene {scene!r}: this test is of NICO's table")
    return blocks


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


def write_measurement(folder: Path, name: str, table: pd.DataFrame, commit: str) -> None:
    """Write a table to ``NAME.csv``, and the commit and command that made it to ``NAME.json``.

    The folder is made if missing; ``commit`` is that of the code when the measurement began.
    """
    make_folder(folder)
    write_table(folder / f"{name}.csv", table)
    write_json(folder / f"{name}.json", {"commit": commit, "command": command()})


def style_success(figure: Figure, axes: Axes) -> None:
    """Give axes of success their scale, and the figure its legend."""
    axes.set_ylim(0, 1.02)
    axes.set_ylabel("Success rate", fontsize=9)
    axes.yaxis.set_major_formatter(PercentFormatter(1, decimals=0))
    style_axes(axes)
    add_legend(figure, *axes.get_legend_handles_labels(), figure.get_figwidth())
