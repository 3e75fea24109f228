"""The paper's first experiment: NICO's three tasks, all presented from the start (Fig. 6).

    python benchmarks/concurrent.py --preset quick

It differs from `continual.py` by the schedule alone, and leaves the same files behind.
"""

from __future__ import annotations

if __name__ == "concurrent":
    # Whatever the scripts of this folder import finds this file where it wants the standard
    # library's `concurrent`, of which only the folder matters.
    import sysconfig

    __path__ = [f"{sysconfig.get_path('stdlib')}/concurrent"]
else:
    from dataclasses import replace

    from experiment import Arguments, command_line, run_config, run_experiment

    def main(arguments: Arguments) -> None:
        """Runs the experiment."""
        config = run_config(arguments)
        run_experiment(arguments, "concurrent", replace(config, task_starts=(0, 0, 0)))

    if __name__ == "__main__":
        command_line(main, __doc__)
