"""Cost of a training step by algorithm, tasks and device, interleaved in one process.

    python benchmarks/speed/steps.py bgpo-single bgpo bgpo-experts dist-nll maml
    python benchmarks/speed/steps.py bgpo --tasks 3 8 --played 1500
    python benchmarks/speed/steps.py bgpo --devices cpu cuda --seeds 10

A step covers all seeds: act, simulate, render and encode while an update, if one is due, runs in a
background thread, then store. An algorithm's update is due as often as in its runs
(``update_every``); updates are timed alone, too. Before timing, each algorithm trains on all tasks
until it has groups and updates. Simulations run on the CPU whatever the device of the networks;
the memory is what PyTorch has taken of a GPU at most.
"""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Annotated

import numpy as np
import torch
import tyro
from timing import interleave

from bgpo_trl.algorithms import Algorithm, entry
from bgpo_trl.analysis.tables import markdown
from bgpo_trl.encoders.pretrained import load_pretrained
from bgpo_trl.experiments.command_line import command_line
from bgpo_trl.machine import choose_device, keep_freed_memory, set_threads
from bgpo_trl.transforms import TaskSchedule
from bgpo_trl.world import World
from suites import nico


@dataclass(frozen=True)
class Arguments:
    """Time training steps and updates."""

    algorithms: Annotated[tuple[str, ...], tyro.conf.Positional] = (
        "bgpo-single",
        "bgpo",
        "bgpo-experts",
        "dist-nll",
        "maml",
    )
    """Algorithms to compare; ratios are to the first."""
    tasks: tuple[int, ...] = (3,)
    """Numbers of tasks: the first so many of the suite."""
    devices: tuple[str, ...] = ("cpu",)
    """Devices of the networks."""
    seeds: int = 5
    """Seeds per batch."""
    played: int = 400
    """Training steps before timing."""
    steps: int = 20
    """Training steps per round."""
    rounds: int = 25
    """Timing rounds."""


class Steps:
    """Algorithm in training, without logging and evaluation.

    Args:
        algorithm: The learner.
        world: Its environment.
    """

    def __init__(self, algorithm: Algorithm, world: World) -> None:
        self.algorithm, self.env = algorithm, world.env
        self.update_every = algorithm.config.rl.update_every
        self._background, self._played = ThreadPoolExecutor(1, "update"), 0
        self._state = self.env.reset()

    def play(self, steps: int) -> None:
        """Take training steps, with the updates that are due."""
        for _ in range(steps):
            state = self.algorithm.act(self._state)
            due = self._played % self.update_every == 0
            update = self._background.submit(self.algorithm.update) if due else None
            transition, self._state = self.env.step_and_maybe_reset(state)
            if update is not None:
                update.result()
            self.algorithm.store(transition)
            self._played += 1
        _finish()

    def update(self, count: int) -> None:
        """Make updates without environment steps."""
        for _ in range(count):
            self.algorithm.update()
        _finish()


def _finish() -> None:
    """Wait for what was started on a GPU."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def main(arguments: Arguments) -> None:
    """Print the table."""
    set_threads(1)
    keep_freed_memory()
    encoders, bank = load_pretrained(tasks=nico.ALL_TASKS[: max(arguments.tasks)])
    running: dict[str, Steps] = {}
    for name, n_tasks, device in product(arguments.algorithms, arguments.tasks, arguments.devices):
        known, seeds = entry(name), range(arguments.seeds)
        seen = bank.for_tasks(nico.ALL_TASKS[:n_tasks]).seen()
        place = choose_device(device)
        algorithm = known.make(
            known.config, seeds=seeds, bank=seen, encoders=encoders, device=place
        )
        world = World(algorithm, schedule=TaskSchedule((0,) * n_tasks))
        key = f"{name}, {n_tasks} tasks, {device}"
        running[key] = Steps(algorithm, world)
        running[key].play(arguments.played)

    rows = [["what", "algorithm", "ms", "times the first", "CPU time, times the first"]]
    for what, described in (("play", "training step"), ("update", "update")):
        calls = {
            name: partial(getattr(steps, what), arguments.steps) for name, steps in running.items()
        }
        wall = interleave(calls, rounds=arguments.rounds)
        cpu = interleave(calls, rounds=arguments.rounds, clock=time.process_time)
        first = next(iter(running))
        for name in running:
            ms = 1_000 * np.median(wall[name]) / arguments.steps
            ratios = [np.median(np.divide(times[name], times[first])) for times in (wall, cpu)]
            rows.append([described, name, f"{ms:.1f}", *(f"{ratio:.2f}" for ratio in ratios)])
    print(markdown(rows))
    if torch.cuda.is_available():
        print(f"{torch.cuda.get_device_name()}: {torch.cuda.max_memory_allocated() / 1e6:.0f} MB")


if __name__ == "__main__":
    command_line(main)
