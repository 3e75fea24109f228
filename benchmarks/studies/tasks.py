"""Tasks of the suite: demonstrators, random actions, and the spread of the starts.

python benchmarks/studies/tasks.py
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from bgpo_trl.analysis.tables import Table, markdown
from bgpo_trl.experiments.command_line import command_line
from bgpo_trl.files.writing import check_folder, write_whole
from suites import nico, opengl
from suites.nico.base import CONTROL_TIMESTEP, TIME_LIMIT, Environment
from suites.nico.demonstrator import Demonstrator

_COLUMNS, _WIDTH, _HEIGHT, _TITLE, _GAP = 6, 128, 64, 14, 4
_STEPS = round(TIME_LIMIT / CONTROL_TIMESTEP)
_SPREADS = (0.0, 0.5, 1.0)  # of which start states are drawn


@dataclass(frozen=True)
class TasksArguments:
    """Start states of the tasks."""

    starts: int = 200
    """Start states of each task, and episodes of random actions."""
    seed: int = 101
    """Seed of the starts and of the actions."""
    pictures: Path | None = None
    """Folder to draw tasks.png, demonstrations, and starts.png, start states, to."""


class Demonstration(NamedTuple):
    """An episode of a demonstrator.

    Attributes:
        start: Where the objects were at first, x and y (m), ``[3, 2]``.
        frames: The frames, of which there are none if states are observed.
        steps: Number of steps.
        success: Whether the task was solved.
    """

    start: NDArray[np.float64]
    frames: list[NDArray[np.uint8]]
    steps: int
    success: bool


def demonstrate(env: Environment, demonstrator: Demonstrator) -> Demonstration:
    """Play an episode of the demonstrator."""
    timestep, timesteps = env.reset(), []
    start = places(env.physics)
    demonstrator.reset()
    timesteps.append(timestep)
    while not timestep.last():
        timestep = env.step(demonstrator(timestep))
        timesteps.append(timestep)
    frames = [step.observation["pixels"] for step in timesteps if "pixels" in step.observation]
    return Demonstration(start, frames, len(timesteps) - 1, bool(timestep.reward))


def places(physics: nico.Physics) -> NDArray[np.float64]:
    """Return where the objects are now, x and y (m), ``[3, 2]``."""
    return np.stack([physics.object_position(name)[:2] for name in nico.OBJECTS])


def chance(name: str, episodes: int, seed: int) -> float:
    """Return the share of episodes of 50 uniformly random actions that solve a task.

    Episodes of all tasks have the same starts and actions.
    """
    env, random = nico.load(name, seed=seed, observation="state"), np.random.default_rng(seed)
    solved = 0
    for _ in range(episodes):
        timestep = env.reset()
        for action in random.uniform(-1.0, 1.0, (_STEPS, 4)):
            timestep = env.step(action)
            if timestep.last():
                break
        solved += bool(timestep.reward)
    return solved / episodes


def draw_demonstrations(tasks: Sequence[str], seed: int) -> Image.Image:
    """Return the first successful demonstration of each task as a titled row of frames."""
    rows = []
    for name in tasks:
        env = nico.load(name, seed=seed)
        demonstrator = Demonstrator(env, seed=seed)
        shown = demonstrate(env, demonstrator)
        while not shown.success:
            shown = demonstrate(env, demonstrator)
        chosen = np.linspace(0, shown.steps, _COLUMNS).round().astype(int)
        rows.append((f"{name}, {shown.steps} steps", [shown.frames[index] for index in chosen]))
    return _draw(rows)


def draw_starts(seed: int) -> Image.Image:
    """Return the first frame of some episodes, a titled row for each of several spreads."""
    rows = []
    for spread in _SPREADS:
        env = nico.load(nico.ALL_TASKS[0], seed=seed, spread=spread)
        frames = [env.reset().observation["pixels"] for _ in range(_COLUMNS)]
        rows.append((f"spread {spread:g}", frames))
    return _draw(rows)


def _draw(rows: Sequence[tuple[str, Sequence[NDArray[np.uint8]]]]) -> Image.Image:
    """Return titled rows of enlarged frames."""
    height = _TITLE + _HEIGHT + _GAP
    size = (_COLUMNS * (_WIDTH + _GAP) - _GAP, height * len(rows))
    picture = Image.new("RGB", size, "white")
    for number, (title, frames) in enumerate(rows):
        ImageDraw.Draw(picture).text((0, number * height), title, fill="black")
        for column, frame in enumerate(frames):
            enlarged = Image.fromarray(frame).resize((_WIDTH, _HEIGHT), Image.Resampling.NEAREST)
            picture.paste(enlarged, (column * (_WIDTH + _GAP), number * height + _TITLE))
    return picture


def tasks(arguments: TasksArguments) -> str:
    """Measure the tasks of the suite: demonstrators, random actions, and the spread of the starts.

    Prints tables, and with --pictures draws a demonstration of each task and some start states.

    Raises:
        ValueError: If there are too few starts, or there is no such folder.
        OSError: If the folder is read-only.
    """
    if arguments.starts < 2:
        raise ValueError(f"--starts must be at least 2, got {arguments.starts}")
    if arguments.pictures is not None and not arguments.pictures.is_dir():
        raise ValueError(f"there is no folder {arguments.pictures}: make it first")
    if arguments.pictures is not None:
        # Before minutes of measurements.
        check_folder(arguments.pictures)
        opengl.check()
    names = nico.ALL_TASKS
    starts: dict[str, NDArray[np.float64]] = {}
    table: Table = [["task", "random actions", "demonstrator", "steps"]]
    for name in names:
        env = nico.load(name, seed=arguments.seed, observation="state")
        demonstrator = Demonstrator(env, seed=arguments.seed)
        episodes = [demonstrate(env, demonstrator) for _ in range(arguments.starts)]
        starts[name] = np.stack([episode.start for episode in episodes])
        success = np.mean([episode.success for episode in episodes])
        steps = np.mean([episode.steps for episode in episodes if episode.success] or [np.nan])
        by_chance = chance(name, arguments.starts, arguments.seed)
        table.append([f"`{name}`", f"{by_chance:.1%}", f"{success:.1%}", f"{steps:.1f}"])

    first = starts[names[0]]
    deviation = 100 * first.std(0, ddof=1)  # (cm)
    spread: Table = [["standard deviation of the start, cm", "x", "y"]]
    for name, (x, y) in zip(nico.OBJECTS, deviation, strict=True):
        spread.append([name, f"{x:.2f}", f"{y:.2f}"])
    alike = all(np.array_equal(first, of_task) for of_task in starts.values())
    found = f"The starts of all tasks are {'the same' if alike else 'NOT the same'}."

    if arguments.pictures is not None:
        for name, picture in (
            ("tasks.png", draw_demonstrations(names, arguments.seed)),
            ("starts.png", draw_starts(arguments.seed)),
        ):
            path = arguments.pictures / name
            content = io.BytesIO()
            picture.save(content, format="png", optimize=True)
            write_whole(path, content.getvalue())
            found += f"\npicture: {path}"
    return "\n\n".join([markdown(table), markdown(spread), found])


if __name__ == "__main__":
    command_line(tasks)
