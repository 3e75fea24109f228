"""The command ``bgpo``, also ``python -m bgpo_trl``.

A sub-command's arguments are read before its code is imported, so that ``--help`` is quick.
"""

from __future__ import annotations

import importlib
import sys
from typing import NamedTuple

from bgpo_trl.doctor import DoctorArguments
from bgpo_trl.experiments import arguments
from bgpo_trl.experiments.command_line import command_line


class Command(NamedTuple):
    """A sub-command.

    Attributes:
        group: Title under which it is listed.
        module: Module in which a function has its name.
        kind: Dataclass of its arguments, whose docstring is the help.
        line: A line about it.
    """

    group: str
    module: str
    kind: type
    line: str


_MAKE, _RUN, _LOOK = "make data", "run", "look"
COMMANDS = {
    name: Command(group, f"bgpo_trl.{module}", kind, line)
    for group, name, module, kind, line in (
        (
            *(_MAKE, "record", "experiments.make_data", arguments.RecordArguments),
            "Record demonstrations, or random play.",
        ),
        (
            *(_MAKE, "encoders", "experiments.make_data", arguments.EncodersArguments),
            "Train encoders on recordings.",
        ),
        (
            *(_MAKE, "bank", "experiments.make_data", arguments.MakeBankArguments),
            "Embed recorded demonstrations, for --bank of a run.",
        ),
        (
            *(_MAKE, "probes", "experiments.make_data", arguments.ProbesArguments),
            "Evaluate trained encoders.",
        ),
        (
            *(_RUN, "continual", "experiments.paper", arguments.Arguments),
            "Train on tasks presented one after the other (Fig. 8).",
        ),
        (
            *(_RUN, "concurrent", "experiments.paper", arguments.Arguments),
            "Train on all tasks from the start (Figs. 6 and 9).",
        ),
        (
            *(_RUN, "sweep", "experiments.sweep", arguments.SweepArguments),
            "Run algorithms in settings over many seeds on Ray.",
        ),
        (
            *(_RUN, "doctor", "doctor", DoctorArguments),
            "Check this machine and installation.",
        ),
        (
            *(_LOOK, "report", "experiments.report", arguments.ReportArguments),
            "Write tables and figures of runs, or compare two; copy runs, to share them.",
        ),
        (
            *(_LOOK, "watch", "experiments.watch", arguments.WatchArguments),
            "Film what a run has learned.",
        ),
        (
            *(_LOOK, "one-shot", "experiments.one_shot", arguments.OneShotArguments),
            "Show a trained policy a film of a demonstration.",
        ),
        (
            *(_LOOK, "groups", "experiments.groups", arguments.GroupsArguments),
            "Measure the groups that form from demonstrations.",
        ),
    )
}
"""The sub-commands by name."""


def main() -> None:
    """Run the sub-command that the command line names."""
    name, *options = sys.argv[1:] or ["--help"]
    sys.argv = ["-m", "bgpo_trl", *sys.argv[1:]]  # stored with results, to repeat them
    if name in ("-h", "--help"):
        sys.stdout.write(_listed())
        return
    if name not in COMMANDS:
        sys.stderr.write(f"bgpo: there is no command {name!r}\n{_listed()}")
        sys.exit(2)
    command = COMMANDS[name]
    command_line(
        lambda given: getattr(importlib.import_module(command.module), name.replace("-", "_"))(
            given
        ),
        options,
        kind=command.kind,
        program=f"bgpo {name}",
        line=command.line,
    )


def _listed() -> str:
    """Return the sub-commands by group."""
    lines = ["usage: bgpo COMMAND [OPTIONS], bgpo COMMAND --help", ""]
    lines.append("BGPO: behavior self-organization for continual robot learning.")
    for group in dict.fromkeys(command.group for command in COMMANDS.values()):
        lines += ["", group]
        lines += [f"  {name:<12}{c.line}" for name, c in COMMANDS.items() if c.group == group]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
