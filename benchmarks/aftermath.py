"""The aftermath of successes: whether they last when the episode goes on.

    python benchmarks/aftermath.py runs/continual-bgpo-quick
    python benchmarks/aftermath.py --demonstrators

tests the policies of all seeds of a run, or the demonstrators of all tasks, and continues the
simulation from each success: what was grasped is lifted, in the best of fourteen ways; what was
pushed together, aside or pressed is left alone for two seconds. Beside them it plays random actions
from the same starts. Prints a table and writes ``aftermath.csv``, one row per success, and
``aftermath.json`` (commit and command).
"""

from __future__ import annotations

import csv
import json
import shlex
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import tyro

from bgpo_trl.experiments.aftermath import (
    Row,
    aftermath_table,
    check_criteria,
    judge,
    policy_episodes,
    scripted_episodes,
)
from bgpo_trl.experiments.arguments import ImportArguments, command_line
from bgpo_trl.experiments.episodes import Episode, load_blocks
from bgpo_trl.experiments.run import commit_of_code
from bgpo_trl.machine import set_threads
from bgpo_trl.plugins import import_plugin
from suites import nico
from suites.nico.base import CONTROL_TIMESTEP, TIME_LIMIT


@dataclass(frozen=True)
class Arguments(ImportArguments):
    """Continue the simulation from the successes of policies."""

    run: tyro.conf.Positional[Path | None] = None
    """Run directory."""
    demonstrators: bool = False
    """Also test the demonstrators; without a run, those of all tasks."""
    episodes: int = 20
    """Test episodes per task and seed."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the starts without a run, which has its own."""
    out: Path | None = None
    """Folder to write to; the run directory, or runs/aftermath, by default."""
    threads: int = 1
    """Threads of PyTorch."""


def episodes_of(arguments: Arguments) -> dict[str, list[Episode]]:
    """Return the test episodes by actor.

    Raises:
        ValueError: If nobody is to act, in no episode, or there is no criterion for a task.
    """
    if arguments.run is None and not arguments.demonstrators:
        raise ValueError("nobody acts: name a run directory, or give --demonstrators")
    if arguments.episodes < 1:
        raise ValueError(f"--episodes must be at least 1, got {arguments.episodes}")
    tasks, seeds, spread = nico.ALL_TASKS, arguments.seeds, 1.0
    max_steps = round(TIME_LIMIT / CONTROL_TIMESTEP)
    episodes: dict[str, list[Episode]] = {}
    if arguments.run is not None:
        runs = load_blocks(arguments.run)
        config = runs[0].config
        tasks, max_steps = config.tasks, config.algorithm.max_steps
        spread = config.spread
        seeds = [seed for run in runs for seed in run.config.seeds]
        check_criteria(tasks)
        played = [policy_episodes(run, arguments.episodes) for run in runs]
        episodes["policy"] = [episode for of_run in played for episode in of_run]
    for actor in ("demonstrators", "random actions")[not arguments.demonstrators :]:
        episodes[actor] = scripted_episodes(
            tasks, seeds, arguments.episodes, max_steps, actor, spread
        )
    return episodes


def main(arguments: Arguments) -> None:
    """Run the tests, print the table and write the files."""
    commit = commit_of_code()
    import_plugin(arguments.module)
    set_threads(arguments.threads)
    episodes = episodes_of(arguments)
    rows = [row for actor, of_actor in episodes.items() for row in judge(actor, of_actor)]
    out = arguments.out or arguments.run or Path("runs/aftermath")
    out.mkdir(parents=True, exist_ok=True)
    with (out / "aftermath.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(Row._fields)
        writer.writerows(rows)
    record = {"commit": commit, "command": shlex.join(["python", *sys.argv])}
    (out / "aftermath.json").write_text(json.dumps(record, indent=2) + "\n")
    counts = {actor: Counter(e.task for e in of_actor) for actor, of_actor in episodes.items()}
    head, *body = aftermath_table(rows, counts)
    print(f"| {' | '.join(head)} |\n|---|---|{'---:|' * (len(head) - 2)}")
    for cells in body:
        print(f"| {' | '.join(cells)} |")


if __name__ == "__main__":
    command_line(main, __doc__, Arguments)
