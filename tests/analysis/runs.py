"""A small run of three tasks, presented one after the other."""

from pathlib import Path

import numpy as np

from bgpo_trl.analysis.comparison import Run
from bgpo_trl.runs.results import Curves

NAN = np.nan
STARTS = (0, 10, 20)
# Tests after 5, 10, ..., 30 episodes of tasks a, b and c, which start at 0, 10 and 20.
SUCCESS = [
    [0.2, NAN, NAN],
    [0.8, NAN, NAN],
    [0.6, 0.4, NAN],
    [0.7, 0.6, NAN],
    [0.5, 0.7, 0.0],
    [0.5, 0.9, 0.4],
]


def make_run(success=SUCCESS, starts=STARTS, tasks="abc", name="bgpo", directory="x", **summary):
    """Two equal seeds."""
    episodes = 5 * np.arange(1, len(success) + 1)
    config = {"name": name, "task_starts": list(starts), "tasks": list(tasks), "eval_every": 5}
    curves = Curves((0, 1), tuple(tasks), episodes, np.array([success, success]))
    return Run(Path(directory), "BGPO", config, summary, curves)
