"""The paper's first experiment (Fig. 6), all tasks from the start: `bgpo concurrent`."""

from __future__ import annotations

from bgpo_trl.experiments.command_line import command_line
from bgpo_trl.experiments.run import concurrent

if __name__ == "__main__":
    command_line(concurrent)
