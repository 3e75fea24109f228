"""The paper's second experiment: NICO's three tasks, presented one after another (Fig. 8).

    python benchmarks/continual.py --preset quick

writes a run directory with ``config.json``, ``train.csv``, ``eval.csv``, ``final.csv``,
``gwr.csv``, ``cost.csv``, ``summary.json``, ``checkpoint/`` and ``figures/``, among them
``success.png`` (success on each task against training episodes), ``gwr.png`` (nodes of GWR-B in
behavior space, Fig. 7) and ``groups.png``.
"""

from __future__ import annotations

from bgpo_trl.experiments.arguments import Arguments, command_line
from bgpo_trl.experiments.paper import continual


def main(arguments: Arguments) -> None:
    """Run the experiment and print its results."""
    print(continual(arguments))


if __name__ == "__main__":
    command_line(main, __doc__, Arguments)
