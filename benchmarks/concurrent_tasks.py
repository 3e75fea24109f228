"""The paper's first experiment: NICO's three tasks, all presented from the start (Fig. 6).

    python benchmarks/concurrent_tasks.py --preset quick

Differs from `continual.py` only in the schedule of tasks, and writes the same files.
"""

from __future__ import annotations

from bgpo_trl.experiments.arguments import Arguments, command_line
from bgpo_trl.experiments.paper import concurrent


def main(arguments: Arguments) -> None:
    """Run the experiment and print its results."""
    print(concurrent(arguments))


if __name__ == "__main__":
    command_line(main, __doc__, Arguments)
