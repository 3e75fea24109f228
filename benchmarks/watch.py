"""Film the trained policies of a run beside the demonstrations that they were shown.

    python benchmarks/watch.py runs/continual-bgpo-quick

writes ``nico.gif``, ``nico.png`` and ``gwr_growth.png`` into the run's ``figures/``.
"""

from __future__ import annotations

from bgpo_trl.experiments.arguments import command_line
from bgpo_trl.experiments.watch import WatchArguments, watch


def main(arguments: WatchArguments) -> None:
    """Write the pictures and print the outcomes."""
    print(watch(arguments))


if __name__ == "__main__":
    command_line(main, __doc__, WatchArguments)
