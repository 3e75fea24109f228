"""The test of looking: success of a run's policies with the places of the objects hidden.

    python benchmarks/looking.py runs/continual-bgpo-quick

tests the policies of all seeds as they are; with places hidden, where each object is shown at its
nominal place plus how far it has moved since the start; and with objects hidden, where each is
always shown at its nominal place. Beside them it plays random actions from the same starts. Prints
a table and writes ``looking.csv``, ``looking.png`` and ``looking.json`` (commit and command) into
the run directory.
"""

from __future__ import annotations

import csv
import json
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from bgpo_trl.experiments.arguments import ImportArguments, command_line
from bgpo_trl.experiments.episodes import load_blocks
from bgpo_trl.experiments.looking import (
    VIEWS,
    Row,
    looking_table,
    measure_looking,
    success_by_condition,
)
from bgpo_trl.experiments.run import commit_of_code
from bgpo_trl.figures.bars import plot_success_bars
from bgpo_trl.figures.style import save_figure
from bgpo_trl.files.progress import progress_bar
from bgpo_trl.machine import set_threads
from bgpo_trl.plugins import import_plugin


@dataclass(frozen=True)
class Arguments(ImportArguments):
    """Test whether the policies of a run look at the objects."""

    run: tyro.conf.Positional[Path]
    """Run directory."""
    episodes: int = 20
    """Test episodes per task and seed, in each condition."""
    out: Path | None = None
    """Folder to write to; the run directory by default."""
    threads: int = 1
    """Threads of PyTorch."""


def main(arguments: Arguments) -> None:
    """Run the tests, print the table and write the files."""
    commit, out = commit_of_code(), arguments.out or arguments.run
    import_plugin(arguments.module)
    set_threads(arguments.threads)
    rows: list[Row] = []
    for run in load_blocks(arguments.run):
        steps = len(VIEWS) * (run.config.algorithm.max_steps + 1)
        with progress_bar("looking", total=steps, unit="step") as bar:
            rows += measure_looking(run, arguments.episodes, bar.update)
    out.mkdir(parents=True, exist_ok=True)
    with (out / "looking.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(Row._fields)
        writer.writerows(rows)
    tasks, success = success_by_condition(rows)
    save_figure(plot_success_bars(success, tasks), out / "looking.png")
    record = {"commit": commit, "command": shlex.join(["python", *sys.argv])}
    (out / "looking.json").write_text(json.dumps(record, indent=2) + "\n")
    head, *body = looking_table(rows)
    print(f"| {' | '.join(head)} |\n|---{'|---:' * (len(head) - 1)}|")
    for cells in body:
        print(f"| {' | '.join(cells)} |")


if __name__ == "__main__":
    command_line(main, __doc__, Arguments)
