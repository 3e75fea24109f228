"""Cost of BGPO's training step by device of the networks, interleaved in one process.

    python benchmarks/speed/devices.py cpu cuda --seeds 1 10 50

Simulations run on the CPU in every case. A step covers all seeds, as in ``steps.py``; an update is
timed alone, too. Before timing, each trains on three tasks until it has groups and updates. The
memory is what PyTorch has taken of a GPU at most.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Annotated, Literal

import numpy as np
import torch
import tyro
from steps import Steps
from timing import interleave

from bgpo_trl.algorithms import entry
from bgpo_trl.encoders.pretrained import load_pretrained
from bgpo_trl.experiments.command_line import command_line
from bgpo_trl.machine import choose_device, keep_freed_memory, set_threads
from bgpo_trl.transforms import TaskSchedule
from bgpo_trl.world import World


@dataclass(frozen=True)
class Arguments:
    """Time training steps and updates on devices."""

    devices: Annotated[tuple[str, ...], tyro.conf.Positional] = ("cpu", "cuda")
    """Devices to compare; ratios are to the first."""
    seeds: tuple[int, ...] = (1, 10)
    """Numbers of seeds in a batch."""
    threads: int = 1
    """Threads of PyTorch on the CPU."""
    played: int = 400
    """Training steps before timing."""
    steps: int = 20
    """Training steps or updates per round."""
    rounds: int = 10
    """Timing rounds."""


def training(device: str, n_seeds: int) -> Steps:
    """Return BGPO in training with its networks on a device."""
    encoders, bank = load_pretrained()
    known, seeds, seen = entry("bgpo"), range(n_seeds), bank.seen()
    place = choose_device(device)
    algorithm = known.make(known.config, seeds=seeds, bank=seen, encoders=encoders, device=place)
    world = World(algorithm, seeds=seeds, schedule=TaskSchedule((0, 0, 0)), bank=seen)
    return Steps(algorithm, world)


def finish(call: partial[None]) -> None:
    """Make a call, and wait for what it started on a GPU."""
    call()
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def main(arguments: Arguments) -> None:
    """Print the table."""
    set_threads(arguments.threads)
    keep_freed_memory()
    print("| seeds | what | device | ms | times the first |")
    print("|---:|---|---|---:|---:|")
    whats: tuple[Literal["play", "update"], ...] = ("play", "update")
    for n_seeds in arguments.seeds:
        running = {device: training(device, n_seeds) for device in arguments.devices}
        for steps in running.values():
            steps.play(arguments.played)
        for what, count in product(whats, [arguments.steps]):
            calls = {
                device: partial(finish, partial(getattr(steps, what), count))
                for device, steps in running.items()
            }
            times = interleave(calls, rounds=arguments.rounds)
            first = times[arguments.devices[0]]
            for device, taken in times.items():
                ms, ratio = 1e3 * np.median(taken) / count, np.median(np.divide(taken, first))
                described = "training step" if what == "play" else "update"
                print(
                    f"| {n_seeds} | {described} | {device} | {ms:.1f} | {ratio:.2f} |", flush=True
                )
    if torch.cuda.is_available():
        print(f"{torch.cuda.get_device_name()}: {torch.cuda.max_memory_allocated() / 1e6:.0f} MB")


if __name__ == "__main__":
    command_line(main)
