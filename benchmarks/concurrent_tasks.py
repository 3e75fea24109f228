"""The paper's first experiment: NICO's three tasks, all presented from the start (Fig. 6).

    python benchmarks/concurrent_tasks.py --preset quick

Differs from `continual.py` only in the schedule of tasks, and writes the same files.
"""

from __future__ import annotations

from dataclasses import replace

from bgpo_trl.experiments.run import Arguments, command_line, run_config, run_experiment


def main(arguments: Arguments) -> None:
    """Run the experiment."""
    config = run_config(arguments)
    print(run_experiment(arguments, "concurrent", replace(config, task_starts=(0, 0, 0))))


if __name__ == "__main__":
    command_line(main, __doc__)
