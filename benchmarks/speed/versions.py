"""A training step of BGPO in two versions of this package, part by part, in turns.

    git worktree add ../before 6cac0ef
    python benchmarks/speed/versions.py ../before . --seeds 1 3 10

Times are CPU times, of processes with one thread of torch. Both versions train as many experts with
the same hidden layers on as many transitions, in their own version of the world.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

PARTS = ("act", "environment", "store", "sample", "learn", "whole step")
BARE = "products of learn"
MEMORY = "peak memory, MB"  # of a process, with the numbers of seeds before
HIDDEN, SHARE, WARM_UP = (256, 256), 0.25, 131  # SHARE: of demonstrated transitions
STATE, ACTION = 96, 4  # sizes of a policy's input, latent and behavior, and output


@dataclass(frozen=True)
class Arguments:
    """Compare the speed of two versions."""

    before: Annotated[Path, tyro.conf.Positional]
    """Folder of the one version."""
    after: Annotated[Path, tyro.conf.Positional]
    """Folder of the other."""
    seeds: tuple[int, ...] = (1, 3, 10)
    """Numbers of seeds."""
    experts: int = 3
    """Experts of each seed."""
    rows: int = 64
    """Transitions of an expert in an update."""
    rounds: int = 15
    """Turns of each version."""
    steps: int = 10
    """Steps in each turn."""


def start(folder: Path, arguments: Arguments) -> subprocess.Popen[str]:
    """Start a process that trains with the version in a folder."""
    numbers = map(str, (arguments.experts, arguments.rows, arguments.steps))
    return subprocess.Popen(
        [sys.executable, Path(__file__).resolve(), "--work", *numbers],
        env={**os.environ, "PYTHONPATH": str(folder.resolve()), "OMP_NUM_THREADS": "1"},
        cwd=folder,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def ask(process: subprocess.Popen[str], seeds: int) -> list[float]:
    """Return the CPU times (ms) of a step's parts and products, and the peak memory (MB)."""
    assert process.stdin and process.stdout
    print(seeds, file=process.stdin, flush=True)
    return [float(part) for part in process.stdout.readline().split()]


def work(experts: int, rows: int, steps: int) -> None:
    """Time some steps for each number of seeds in the input, with the version in use."""
    import bgpo_trl.machine as machine

    machine.set_threads(1)
    if hasattr(machine, "keep_freed_memory"):  # not in earlier versions
        machine.keep_freed_memory()
    training: dict[int, Training] = {}
    for line in sys.stdin:
        seeds = int(line)
        if seeds not in training:
            training[seeds] = Training(seeds, experts, rows)
        times = [*training[seeds].time(steps), time_products(seeds * experts, rows, steps)]
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3  # kilobytes on Linux
        print(*times, peak, flush=True)


def time_products(networks: int, rows: int, repeats: int) -> float:
    """Return the CPU time (ms) of the products of matrices that an update needs, and no more.

    Five networks are evaluated: the targets, the critic on stored actions and on the actor's, and
    the actor. Actor and critic have gradients of their weights, the critic also of the action.
    """
    import torch

    def layers(inputs: int, outputs: int) -> list[tuple[int, int]]:
        return [*zip((inputs, *HIDDEN), (*HIDDEN, outputs), strict=True)]

    actor, critic = layers(STATE, ACTION), layers(STATE + ACTION, 1)
    forward = [(rows, i, o) for i, o in 2 * actor + 3 * critic]
    of_weights = [(i, rows, o) for i, o in actor + critic]
    of_inputs = [(rows, o, i) for i, o in actor[1:] + critic[1:] + critic]
    pairs = [
        (torch.randn(networks, n, k), torch.randn(networks, k, m))
        for n, k, m in forward + of_weights + of_inputs
    ]
    start = time.process_time()
    for _ in range(repeats):
        for one, other in pairs:
            torch.bmm(one, other)
    return 1_000 * (time.process_time() - start) / repeats


class Training:
    """BGPO in training on the paper's tasks, as in a run."""

    def __init__(self, seeds: int, experts: int, rows: int) -> None:
        from bgpo_trl.algorithms import entry
        from bgpo_trl.encoders.pretrained import load_pretrained
        from bgpo_trl.transforms import TaskSchedule
        from bgpo_trl.world import World

        encoders, bank = load_pretrained()
        known, parts = entry("bgpo"), {"seeds": range(seeds), "bank": bank.seen()}
        rl = replace(known.config.rl, warmup_steps=WARM_UP - 1, hidden_sizes=HIDDEN)
        config = replace(
            known.config,
            rl=rl,
            active_groups=experts,
            expert_batch_size=rows,
            demonstration_share=SHARE,
        )
        self.algorithm = known.make(config, encoders=encoders, **parts)
        self.env = World(self.algorithm, schedule=TaskSchedule((0, 0, 0)), **parts).env
        self._background = ThreadPoolExecutor(1, "update")
        self._state = self.env.reset()
        self.time(WARM_UP)
        for group in range(1, experts):  # as if groups had been found, for as many experts
            self.algorithm.experts._parent = lambda *_: 0
            self.algorithm.experts.play([group] * seeds)
        self.time(2)

    def time(self, steps: int) -> list[float]:
        """Take steps; return the CPU times (ms) of the parts of one."""
        algorithm, seconds = self.algorithm, np.zeros(len(PARTS))
        learn, drawn = algorithm.learn, []
        for _ in range(steps):
            marks = [time.process_time()]
            state = algorithm.act(self._state)
            marks.append(time.process_time())
            transition, self._state = self.env.step_and_maybe_reset(state)
            marks.append(time.process_time())
            algorithm.store(transition)
            marks.append(time.process_time())
            algorithm.learn = lambda batch: drawn.append(batch) or {}
            self._background.submit(algorithm.update).result()
            marks.append(time.process_time())
            algorithm.learn = learn
            while drawn:
                self._background.submit(learn, drawn.pop()).result()
            marks.append(time.process_time())
            seconds += [*np.diff(marks), marks[-1] - marks[0]]
        return (1_000 * seconds / steps).tolist()


def main(arguments: Arguments) -> None:
    """Print the table."""
    print("| seeds | part, ms | before | after | after / before | quartiles |")
    print("|---:|---|---:|---:|---:|---:|")
    before = start(arguments.before, arguments)
    after = start(arguments.after, arguments)
    with before as one, after as other:
        for seeds in arguments.seeds:
            rounds = range(arguments.rounds)
            times = np.array([[ask(one, seeds), ask(other, seeds)] for _ in rounds])
            for part, taken in zip([*PARTS, BARE, MEMORY], times.transpose(2, 0, 1), strict=True):
                before, after = np.median(taken, 0)
                low, ratio, high = np.percentile(taken[:, 1] / taken[:, 0], [25, 50, 75])
                print(
                    f"| {seeds} | {part} | {before:.2f} | {after:.2f} | {ratio:.2f} "
                    f"| {low:.2f}-{high:.2f} |",
                    flush=True,
                )


if __name__ == "__main__":
    if sys.argv[1:2] == ["--work"]:
        work(*map(int, sys.argv[2:]))
    else:
        main(tyro.cli(Arguments))
