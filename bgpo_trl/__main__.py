"""The command ``bgpo``, also ``python -m bgpo_trl``.

A sub-command is imported when it is chosen: the list of all is there at once.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable

import tyro

COMMANDS = {
    "continual": ("experiments.paper", "Train on tasks presented one after the other (Fig. 8)."),
    "concurrent": ("experiments.paper", "Train on all tasks from the start (Fig. 6)."),
    "ablation": ("experiments.paper", "Train BGPO without some of its parts (Fig. 9)."),
    "sweep": ("experiments.sweep", "Run algorithms in settings over many seeds on Ray."),
    "eight-tasks": ("experiments.sweep", "Run the benchmark of eight tasks, as a sweep."),
    "merge": ("experiments.merge", "Merge runs of different seeds into one."),
    "report": ("experiments.report", "Write tables and figures of runs, or compare two."),
    "watch": ("experiments.watch", "Film what a run has learned."),
    "looking": ("experiments.nico.looking", "Test a run of NICO with the objects' places hidden."),
    "aftermath": (
        "experiments.nico.aftermath",
        "Test whether successes of a run of NICO last.",
    ),
    "one-shot": ("experiments.one_shot", "Test a run with demonstrations cut short."),
    "unknown-task": ("experiments.groups", "Measure how well new tasks are detected."),
    "groups": ("experiments.groups", "Measure the groups that form from demonstrations."),
    "privileged-information": (
        "experiments.privileged_information",
        "Train with less and less given information.",
    ),
    "tasks": ("experiments.nico.tasks", "Measure NICO's tasks and their demonstrators."),
    "doctor": ("doctor", "Check this machine and installation."),
}
"""Module of each sub-command, whose function has its name, and a line about it."""


def main() -> None:
    """Run the sub-command that the command line names."""
    name, *options = sys.argv[1:] or ["--help"]
    sys.argv = ["-m", "bgpo_trl", *sys.argv[1:]]  # stored with results, to repeat them
    if name not in COMMANDS:
        listed = {command: _listed(line) for command, (_, line) in COMMANDS.items()}
        description = "BGPO: behavior self-organization for continual robot learning."
        tyro.extras.subcommand_cli_from_dict(
            listed, prog="bgpo", description=description, args=[name, *options]
        )
        return
    try:
        from bgpo_trl.experiments.command_line import command_line

        module = importlib.import_module(f"bgpo_trl.{COMMANDS[name][0]}")
    except KeyboardInterrupt:
        sys.exit("interrupted")
    command = getattr(module, name.replace("-", "_"))
    command_line(command, options, program=f"bgpo {name}")


def _listed(line: str) -> Callable[[], None]:
    def command() -> None:
        pass

    command.__doc__ = line
    return command


if __name__ == "__main__":
    main()
