"""The command ``bgpo``, also ``python -m bgpo_trl``.

A sub-command's arguments are read before its code is imported, so that ``--help`` is quick.
"""

from __future__ import annotations

import importlib
import inspect
import sys
from typing import Any

from bgpo_trl.experiments import arguments
from bgpo_trl.experiments.command_line import command_line
from bgpo_trl.interrupts import interrupts_wait

COMMANDS: dict[str, dict[str, tuple[str, type]]] = {
    "make data": {
        "record": ("experiments.make_data", arguments.RecordArguments),
        "encoders": ("experiments.make_data", arguments.EncodersArguments),
        "bank": ("experiments.make_data", arguments.MakeBankArguments),
        "probes": ("experiments.make_data", arguments.ProbesArguments),
    },
    "run": {
        "continual": ("experiments.run", arguments.Arguments),
        "concurrent": ("experiments.run", arguments.Arguments),
        "sweep": ("experiments.sweep", arguments.SweepArguments),
        "doctor": ("experiments.doctor", arguments.DoctorArguments),
    },
    "look": {
        "report": ("experiments.report", arguments.ReportArguments),
        "watch": ("experiments.watch", arguments.WatchArguments),
        "one-shot": ("experiments.watch", arguments.OneShotArguments),
        "groups": ("experiments.groups", arguments.GroupsArguments),
    },
}
"""By the title under which it is listed, each sub-command by name: the module in which a function
has its name, and the dataclass of its arguments, whose docstring is the help."""
_LINES = {
    "continual": "Train on tasks presented one after the other (Fig. 8).",
    "concurrent": "Train on all tasks from the start (Figs. 6 and 9).",
}


def main() -> None:
    """Run the sub-command that the command line names."""
    name, *options = sys.argv[1:] or ["--help"]
    sys.argv = ["-m", "bgpo_trl", *sys.argv[1:]]  # stored with results, to repeat them
    if name in ("-h", "--help"):
        sys.stdout.write(_listed())
        return
    commands = {
        name: command for of_group in COMMANDS.values() for name, command in of_group.items()
    }
    if name not in commands:
        sys.stderr.write(f"bgpo: there is no command {name!r}\n{_listed()}")
        sys.exit(2)
    module, kind = commands[name]

    def command(given: Any) -> str | None:
        with interrupts_wait():  # libraries that are interrupted while they load may abort
            loaded = importlib.import_module(f"bgpo_trl.{module}")
        return getattr(loaded, name.replace("-", "_"))(given)

    command_line(
        command,
        options,
        kind=kind,
        program=f"bgpo {name}",
        line=_LINES.get(name, ""),
    )


def _listed() -> str:
    """Return the sub-commands by group, each with a line about it."""
    lines = ["usage: bgpo COMMAND [OPTIONS], bgpo COMMAND --help", ""]
    lines.append("BGPO: behavior self-organization for continual robot learning.")
    for group, commands in COMMANDS.items():
        lines += ["", group]
        for name, (_, kind) in commands.items():
            line = _LINES.get(name) or str(inspect.getdoc(kind)).splitlines()[0]
            lines.append(f"  {name:<12}{line}")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
