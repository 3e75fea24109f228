"""Command line of the installed package: ``python -m bgpo_trl continual --preset quick``."""

from __future__ import annotations

import sys

USAGE = """usage: python -m bgpo_trl COMMAND [OPTIONS]

  continual   learn the tasks one after the other
  concurrent  learn all tasks from the start
  ablation    learn with a variant of BGPO
  watch       film what a run has learned
  doctor      check this installation

python -m bgpo_trl COMMAND --help shows the options."""


def main(arguments: list[str]) -> None:
    """Run a command, given its name and options."""
    name, *options = arguments or ["--help"]
    if name == "doctor":
        from bgpo_trl.doctor.__main__ import main as examine

        sys.exit(examine(options))
    if name not in ("continual", "concurrent", "ablation", "watch"):
        sys.exit(USAGE if name in ("-h", "--help") else f"error: no command {name!r}\n{USAGE}")
    # Imported late, since the other commands do without TorchRL, which takes seconds to import.
    from bgpo_trl.experiments import paper, watch
    from bgpo_trl.experiments.arguments import Arguments, command_line

    kinds = {"ablation": paper.AblationArguments, "watch": watch.WatchArguments}
    run = watch.watch if name == "watch" else getattr(paper, name)
    sys.argv = ["-m", "bgpo_trl", name, *options]  # stored in a run's summary.json
    command_line(lambda asked: print(run(asked)), run.__doc__, kinds.get(name, Arguments), options)


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except KeyboardInterrupt:  # while it imports
        sys.exit("interrupted")
