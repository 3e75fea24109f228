"""Speed of each part of training, against its upper bound and its usual alternatives.

    python benchmarks/speed/throughput.py

prints tables and writes ``throughput.json``: frames per second, DDPG updates per second, the
training step of BGPO in a batch of seeds against one seed after another, and memory over a long
run. Contenders take turns, round by round, since the speed of a machine varies; a ratio is the
median of the rounds' ratios. Times are medians with quartiles; those of updates, which use one
thread, are CPU times.
"""

from __future__ import annotations

import json
import platform
import resource
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import frames
import torch
import updates
from steps import Steps
from timing import Timing, interleave, ratio

from bgpo_trl.algorithms.bgpo import BGPO
from bgpo_trl.analysis.tables import markdown
from bgpo_trl.configs import BGPOConfig
from bgpo_trl.encoders.pretrained import load_pretrained
from bgpo_trl.experiments.command_line import command_line
from bgpo_trl.machine import keep_freed_memory, usable_cores
from bgpo_trl.transforms import TaskSchedule
from bgpo_trl.world import World

Part = Literal["frames", "updates", "step", "memory"]
Table = dict[str, dict[str, Any]]


@dataclass(frozen=True)
class Arguments:
    """Measure the speed of all parts."""

    parts: tuple[Part, ...] = ("frames", "updates", "step", "memory")
    """Parts to measure."""
    seeds: int = 10
    """Seeds per batch."""
    rounds: int = 100
    """Timing rounds of each comparison."""
    steps: int = 3_000
    """Training steps of the memory measurement."""
    threads: int | None = None
    """Threads for physics; one per core by default. PyTorch uses one, as in training."""
    out: Path = Path("runs/speed")
    """Folder of throughput.json."""


def measure_frames(arguments: Arguments, threads: int) -> Table:
    """Time a frame: the bare limit, the layers of this package and stock dm_control."""
    encoders, _ = load_pretrained()
    each = _time_each(frames.contenders(threads, encoders.frame_network), arguments.rounds)
    return {
        name: {
            "frames a second": 1 / Timing.of(taken).median,
            "ms a frame": _milliseconds(taken),
            **{
                f"share of the bare limit, {n} threads": ratio(
                    each[f"bare limit, {n} threads"], taken
                ).median
                for n in sorted({1, threads})
            },
            "times stock": ratio(each["stock"], taken).median,
        }
        for name, taken in each.items()
    }


def measure_updates(arguments: Arguments) -> Table:
    """Time an update of one seed: this package, the floor, TorchRL's loop and Stable-Baselines3."""
    contenders = updates.contenders(arguments.seeds)
    each = _time_each(contenders, arguments.rounds, clock=time.process_time)
    floor = next(name for name in each if name.startswith("floor"))
    rivals = [name for name in each if name.startswith(("TorchRL", "Stable-Baselines3"))]
    return {
        name: {
            "updates a second a seed": 1 / Timing.of(taken).median,
            "ms an update": _milliseconds(taken),
            "share of the floor": ratio(each[floor], taken).median,
            **{f"times {rival}": ratio(each[rival], taken).median for rival in rivals},
        }
        for name, taken in each.items()
    }


class Training(Steps):
    """BGPO in training on the paper's tasks, past its warm-up.

    Args:
        seeds: Seeds of the batch.
    """

    def __init__(self, seeds: range) -> None:
        encoders, bank = load_pretrained()
        algorithm = BGPO(BGPOConfig(), seeds=seeds, bank=bank.seen(), encoders=encoders)
        self.world = World(algorithm, schedule=TaskSchedule((0, 0, 0)))
        super().__init__(algorithm, self.world)
        self.play(algorithm.config.rl.warmup_steps + 1)

    def time_parts(self) -> dict[str, float]:
        """Time every part from now on; return seconds by part, a dict updated in place."""
        seconds: dict[str, float] = defaultdict(float)

        def keep_time(owner: Any, method: str, part: str) -> None:
            call = getattr(owner, method)

            def timed(*args: Any, **kwargs: Any) -> Any:
                start = time.perf_counter()
                try:
                    return call(*args, **kwargs)
                finally:
                    seconds[part] += time.perf_counter() - start

            object.__setattr__(owner, method, timed)

        algorithm, world = self.algorithm, self.world
        keep_time(world.simulation, "_step", "simulate (physics and render)")
        keep_time(world.simulation, "_reset", "begin episodes")
        keep_time(world.simulation._renderer, "render", "of which render")
        for transform in world.env.transform:
            keep_time(transform, "_step", type(transform).__name__)
        keep_time(world.env, "step_and_maybe_reset", "whole environment")
        for method in ("act", "update", "store"):
            keep_time(algorithm, method, method)
        keep_time(algorithm, "sample", "of which sample")
        return seconds


def measure_step(arguments: Arguments) -> Table:
    """Time a training step of a batch of seeds and of as many single-seed runs, in turn."""
    batch = Training(range(arguments.seeds))
    singles = [Training(range(seed, seed + 1)) for seed in range(arguments.seeds)]
    every = batch.update_every  # so many steps have one update

    def one_after_the_other() -> None:
        for single in singles:
            single.play(every)

    names = f"{arguments.seeds} seeds in a batch", f"{arguments.seeds} runs of one seed"
    times = interleave(
        dict(zip(names, (partial(batch.play, every), one_after_the_other), strict=True)),
        rounds=arguments.rounds,
    )
    table: Table = {
        name: {
            "ms a step of all": _milliseconds([t / every for t in taken]),
            "share of single runs": ratio(taken, times[names[1]]).median,
        }
        for name, taken in times.items()
    }
    seconds = batch.time_parts()
    batch.play(arguments.rounds * every)
    for part, spent in seconds.items():
        taken = 1e3 * spent / (arguments.rounds * every)
        table[f"{names[0]}: {part}"] = {"ms a step of all": taken}
    return table


def measure_memory(arguments: Arguments) -> Table:
    """Measure the memory of a run over time, and the replay buffer's share of its growth."""
    training = Training(range(arguments.seeds))
    group = torch.zeros(arguments.seeds, 1, dtype=torch.int64)
    stored = training.algorithm.replay.sample(group).exclude("priority_weight")[0, 0]
    transition_size = stored.bytes() + group.element_size()
    marks: list[tuple[int, float, float]] = []
    every = max(1, arguments.steps // 4)
    for step in range(arguments.steps + 1):
        if step % every == 0:
            count = len(training.algorithm.replay)
            marks.append((count, _resident(), count * arguments.seeds * transition_size))
        training.play(1)
    table: Table = {}
    _, first_resident, first_stored = marks[0]
    for stored_steps, resident, stored in marks:
        table[f"{stored_steps} steps stored"] = {
            "MB resident": resident / 1e6,
            "MB grown": (resident - first_resident) / 1e6,
            "MB of it replay": (stored - first_stored) / 1e6,
        }
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    table["highest of all measurements"] = {"MB resident": peak / 1e6}
    return table


def _time_each(
    contenders: dict[str, tuple[Callable[[], object], int]],
    rounds: int,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, list[float]]:
    """Time calls that produce several items each; return seconds per item, round by round."""
    calls = {name: call for name, (call, _) in contenders.items()}
    times = interleave(calls, rounds=rounds, clock=clock)
    return {name: [t / contenders[name][1] for t in taken] for name, taken in times.items()}


def _milliseconds(seconds: list[float]) -> str:
    timing = Timing.of([1e3 * t for t in seconds])
    return f"{timing.median:.3f} ({timing.low:.3f}-{timing.high:.3f})"


def _resident() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize()


def show(table: Table) -> str:
    """Format a table in Markdown."""
    columns = list(dict.fromkeys(column for row in table.values() for column in row))

    def cell(value: float | str) -> str:
        return value if isinstance(value, str) else f"{value:.{0 if value >= 100 else 2}f}"

    rows = [[name, *(cell(row.get(c, "")) for c in columns)] for name, row in table.items()]
    return markdown([["", *columns], *rows])


def main(arguments: Arguments) -> None:
    """Measure the speed of training: frames, updates, steps and memory."""
    if not arguments.parts:
        raise ValueError("--parts is empty: name some of frames, updates, step, memory")
    for name in ("seeds", "rounds", "steps", "threads"):
        number = getattr(arguments, name)
        if number is not None and number < 1:
            raise ValueError(f"--{name} must be at least 1, got {number}")
    threads = arguments.threads or usable_cores()
    torch.set_num_threads(1)
    keep_freed_memory()  # as in runs
    measures: dict[Part, Callable[[], Table]] = {
        "frames": lambda: measure_frames(arguments, threads),
        "updates": lambda: measure_updates(arguments),
        "step": lambda: measure_step(arguments),
        "memory": lambda: measure_memory(arguments),
    }
    found: dict[str, Any] = {
        "machine": {
            "cores": usable_cores(),
            "threads": threads,
            "processor": platform.processor() or platform.machine(),
            "python": platform.python_version(),
            "torch": torch.__version__,
        },
        "arguments": {**asdict(arguments), "out": None},
    }
    arguments.out.mkdir(parents=True, exist_ok=True)
    for part in arguments.parts:
        found[part] = measures[part]()
        print(f"\n{part}\n\n{show(found[part])}", flush=True)
        (arguments.out / "throughput.json").write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    command_line(main)
