"""The benchmark of eight tasks (docs/benchmark.md), as a sweep on Ray."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from bgpo_trl.experiments.arguments import Setting, SweepArguments
from bgpo_trl.experiments.command_line import command_line
from bgpo_trl.experiments.sweep import sweep


@dataclass(frozen=True)
class EightTasksArguments(SweepArguments):
    """The grid of the benchmark of eight tasks, or a part of it."""

    algorithms: tuple[str, ...] = (
        "bgpo",
        "bgpo-experts",
        "bgpo-single",
        "maml",
        "maml-demonstrations",
        "dist-nll",
        "dist-nll-demonstrations",
        "oracle",
    )
    settings: tuple[Setting, ...] = ("eight", "eight-reversed", "eight-concurrent")
    seeds: tuple[int, ...] | None = (20, 21, 22, 23, 24)
    """Seeds."""
    episodes: int | None = 4_000
    """Training episodes. The task starts are scaled in proportion."""
    eval_every: int | None = None
    """Training episodes between evaluations; by default 50, or fewer in shorter runs."""
    held_out: Literal["validation", "test"] = "test"
    out: Path = Path("runs/eight")


def eight_tasks(arguments: EightTasksArguments) -> str:
    """Run the benchmark of eight tasks (docs/benchmark.md) as a sweep; `bgpo report runs/eight`.

    The same command resumes an interrupted grid.
    """
    if arguments.eval_every is None:
        arguments = replace(arguments, eval_every=min(50, arguments.episodes or 50))
    return sweep(arguments)


if __name__ == "__main__":
    command_line(eight_tasks)
