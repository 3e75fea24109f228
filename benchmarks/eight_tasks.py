"""The benchmark of eight tasks (``docs/benchmark.md``): its whole grid, as one sweep on Ray.

    python benchmarks/eight_tasks.py
    python benchmarks/report.py runs/eight

The same command resumes an interrupted grid. ``--algorithms bgpo --settings eight`` runs a part of
it; ``benchmarks/sweep.py`` describes the other arguments.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import sweep

from bgpo_trl.experiments.arguments import command_line


@dataclass(frozen=True)
class Arguments(sweep.Arguments):
    """Run the benchmark of eight tasks on Ray."""

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
    settings: tuple[sweep.Setting, ...] = ("eight", "eight-reversed", "eight-concurrent")
    seeds: tuple[int, ...] | None = (10, 11, 12, 13, 14)
    """Seeds."""
    episodes: int | None = 4_000
    """Training episodes. The task starts are scaled in proportion."""
    eval_every: int | None = None
    """Training episodes between evaluations; by default 50, or fewer in shorter runs."""
    held_out: Literal["validation", "test"] = "test"
    out: Path = Path("runs/eight")


def main(arguments: Arguments) -> None:
    """Run the grid."""
    if arguments.eval_every is None:
        arguments = replace(arguments, eval_every=min(50, arguments.episodes or 50))
    sweep.main(arguments)


if __name__ == "__main__":
    command_line(main, __doc__, Arguments)
