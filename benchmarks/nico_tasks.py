"""Measure the tasks of the suite: success of random actions and of the demonstrators.

    python benchmarks/nico_tasks.py

Prints a table, and with ``--picture`` draws a demonstration of each task as a strip of frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from bgpo_trl.experiments.arguments import command_line
from suites import nico
from suites.nico.base import CONTROL_TIMESTEP, TIME_LIMIT, Environment
from suites.nico.demonstrator import Demonstrator

_FRAMES, _WIDTH, _HEIGHT, _TITLE, _GAP = 6, 128, 64, 14, 4


@dataclass(frozen=True)
class Arguments:
    """Measure the tasks of the suite."""

    starts: int = 200
    """Start states of each task, and episodes of random actions."""
    seed: int = 1
    """Seed of the starts and of the actions."""
    picture: Path | None = None
    """File to draw a demonstration of each task to, .png."""


def demonstrate(env: Environment, demonstrator: Demonstrator) -> tuple[list[NDArray], bool]:
    """Return the frames of a demonstration (empty for states) and whether it succeeded."""
    timestep = env.reset()
    demonstrator.reset()
    frames = [timestep.observation.get("pixels", np.empty(0))]
    while not timestep.last():
        timestep = env.step(demonstrator(timestep))
        frames.append(timestep.observation.get("pixels", np.empty(0)))
    return frames, bool(timestep.reward)


class _Judge(nico.NicoTask):
    """Task that never ends and notes which of the others are solved."""

    def __init__(self, tasks: Sequence[str], seed: int) -> None:
        super().__init__(random=seed, observation="state")
        self._tasks = {name: nico.TASKS[name](random=0) for name in tasks}
        self.solved: set[str] = set()

    def initialize_episode(self, physics: nico.Physics) -> None:
        super().initialize_episode(physics)
        self.solved = set()

    def get_reward(self, physics: nico.Physics) -> float:
        self.solved.update(name for name, task in self._tasks.items() if task.succeeded(physics))
        return 0.0

    def get_termination(self, physics: nico.Physics) -> None:
        del physics


def chance(tasks: Sequence[str], episodes: int, seed: int) -> dict[str, float]:
    """Return the share of episodes of 50 uniformly random actions that solve each task.

    The same episodes serve all tasks, which differ only in their rewards.
    """
    judge = _Judge(tasks, seed)
    physics = nico.Physics.from_xml_string(nico.scene_xml())
    env = Environment(physics, judge, time_limit=TIME_LIMIT, control_timestep=CONTROL_TIMESTEP)
    random = np.random.default_rng(seed)
    counts = dict.fromkeys(tasks, 0)
    for _ in range(episodes):
        timestep = env.reset()
        while not timestep.last():
            timestep = env.step(random.uniform(-1.0, 1.0, 4))
        for name in judge.solved:
            counts[name] += 1
    return {name: count / episodes for name, count in counts.items()}


def draw(tasks: Sequence[str], seed: int) -> Image.Image:
    """Return the first successful demonstration of each task as a titled row of frames."""
    row = _TITLE + _HEIGHT + _GAP
    picture = Image.new("RGB", (_FRAMES * (_WIDTH + _GAP) - _GAP, row * len(tasks)), "white")
    for number, name in enumerate(tasks):
        env = nico.load(name, seed=seed)
        demonstrator = Demonstrator(env, seed=seed)
        frames, success = demonstrate(env, demonstrator)
        while not success:
            frames, success = demonstrate(env, demonstrator)
        title = f"{name}, {len(frames) - 1} steps"
        ImageDraw.Draw(picture).text((0, number * row), title, fill="black")
        shown = np.linspace(0, len(frames) - 1, _FRAMES).round().astype(int)
        for column, index in enumerate(shown):
            frame = Image.fromarray(frames[index])
            enlarged = frame.resize((_WIDTH, _HEIGHT), Image.Resampling.NEAREST)
            picture.paste(enlarged, (column * (_WIDTH + _GAP), number * row + _TITLE))
    return picture


def main(arguments: Arguments) -> None:
    """Run the command line."""
    if arguments.starts < 1:
        raise ValueError(f"--starts must be at least 1, got {arguments.starts}")
    tasks = nico.ALL_TASKS
    by_chance = chance(tasks, arguments.starts, arguments.seed)
    print("| task | chance | demonstrator | steps |\n|---|---:|---:|---:|")
    for name in tasks:
        env = nico.load(name, seed=arguments.seed, observation="state")
        demonstrator = Demonstrator(env, seed=arguments.seed)
        episodes = [demonstrate(env, demonstrator) for _ in range(arguments.starts)]
        success = np.mean([done for _, done in episodes])
        steps = np.mean([len(frames) - 1 for frames, done in episodes if done] or [np.nan])
        print(f"| `{name}` | {by_chance[name]:.1%} | {success:.1%} | {steps:.1f} |", flush=True)
    if arguments.picture is not None:
        draw(tasks, arguments.seed).save(arguments.picture, optimize=True)
        print(f"picture: {arguments.picture}")


if __name__ == "__main__":
    command_line(main, __doc__, Arguments)
