"""An update of BGPO's learner in two versions of this package, in processes that take turns.

    git worktree add ../before 6cac0ef
    python benchmarks/speed/versions.py ../before . --seeds 1 3 10 --experts 3

An update is a gradient step on a constant batch of 128 transitions an expert, with two hidden
layers of 256 units, in a background thread as in training. Times are CPU times of one thread.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import tyro
from tensordict import TensorDict

ROWS, LATENT, CONTEXT, ACTION, HIDDEN = 128, 64, 32, 4, (256, 256)


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
    rl: str = "ddpg"
    """RL algorithm: ddpg, td3 or sac."""
    rounds: int = 15
    """Turns of each version."""


class Worker:
    """A process that makes updates with one version of the package.

    Args:
        folder: The version.
        rl: RL algorithm.
    """

    def __init__(self, folder: Path, rl: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, Path(__file__).resolve(), "--work", rl],
            env={**os.environ, "PYTHONPATH": str(folder.resolve()), "OMP_NUM_THREADS": "1"},
            cwd=folder,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def time(self, seeds: int, experts: int) -> float:
        """Return the CPU time of an update (ms)."""
        process = self._process
        assert process.stdin and process.stdout
        process.stdin.write(f"{seeds} {experts}\n")
        process.stdin.flush()
        return float(process.stdout.readline())

    def close(self) -> None:
        """End the process."""
        self._process.communicate()


def work(rl: str) -> None:
    """Time some updates for each line ``seeds experts`` of the input, with the version in use."""
    torch.set_num_threads(1)
    try:
        from bgpo_trl.machine import keep_freed_memory
    except ImportError:  # an earlier version
        pass
    else:
        keep_freed_memory()
    updates: dict[tuple[int, int], Update] = {}
    with ThreadPoolExecutor(1, "update") as background:
        for line in sys.stdin:
            seeds, experts = map(int, line.split())
            if (seeds, experts) not in updates:
                updates[seeds, experts] = Update(rl, seeds, experts)
                background.submit(updates[seeds, experts], 8).result()
            count, start = max(2, 20 // (seeds * experts)), time.process_time()
            background.submit(updates[seeds, experts], count).result()
            print(1_000 * (time.process_time() - start) / count, flush=True)


class Update:
    """Updates of a learner ``[S, E]`` on a constant batch."""

    def __init__(self, rl: str, seeds: int, experts: int) -> None:
        from bgpo_trl.algorithms.rl import RL, LearnerSpec, make_learner

        keys, device = ["latent", "context"], torch.device("cpu")
        spec = LearnerSpec(range(seeds), keys, LATENT + CONTEXT, (0.0, 1.1), device, range(experts))
        self.learner = make_learner(type(RL[rl].config)(hidden_sizes=HIDDEN), spec)
        generator, shape = torch.Generator().manual_seed(0), (seeds, experts, ROWS)

        def normal(size: int) -> torch.Tensor:
            return torch.randn(*shape, size, generator=generator)

        success = torch.rand(*shape, 1, generator=generator) < 0.1
        root = {
            "latent": normal(LATENT),
            "context": normal(CONTEXT),
            "action": normal(ACTION).tanh(),
        }
        weighted = {
            "priority_weight": torch.ones(shape),
            "demonstrated": torch.arange(ROWS).expand(shape) % 4 > 0,
        }
        following = {"latent": normal(LATENT), "reward": success.float(), "terminated": success}
        self.batch = TensorDict({**root, **weighted, "next": following}, shape)

    def __call__(self, count: int) -> None:
        """Make updates."""
        for _ in range(count):
            self.learner.learn(self.batch)


def main(arguments: Arguments) -> None:
    """Print the table."""
    print("| seeds of experts | before (ms) | after (ms) | after / before | quartiles |")
    print("|---|---:|---:|---:|---:|")
    with ExitStack() as stack:
        workers = [Worker(path, arguments.rl) for path in (arguments.before, arguments.after)]
        for worker in workers:
            stack.callback(worker.close)
        for seeds in arguments.seeds:
            times = np.empty((arguments.rounds, 2))
            for row in times:
                row[:] = [worker.time(seeds, arguments.experts) for worker in workers]
            before, after = np.median(times, 0)
            low, ratio, high = np.percentile(times[:, 1] / times[:, 0], [25, 50, 75])
            print(
                f"| {seeds} of {arguments.experts} | {before:.1f} | {after:.1f} | {ratio:.2f} "
                f"| {low:.2f}-{high:.2f} |",
                flush=True,
            )


if __name__ == "__main__":
    if sys.argv[1:2] == ["--work"]:
        work(sys.argv[2])
    else:
        main(tyro.cli(Arguments))
