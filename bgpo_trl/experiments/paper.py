"""The paper's experiments: tasks one after the other, and all tasks from the start."""

from __future__ import annotations

from bgpo_trl.experiments.arguments import Arguments
from bgpo_trl.experiments.run import run_experiment
from bgpo_trl.experiments.settings import run_config


def continual(arguments: Arguments) -> str:
    """Train an algorithm on tasks that are presented one after the other (Fig. 8)."""
    return run_experiment(arguments, "continual", run_config(arguments))


def concurrent(arguments: Arguments) -> str:
    """Train an algorithm on tasks that are all presented from the start (Figs. 6 and 9)."""
    return run_experiment(arguments, "concurrent", run_config(arguments, from_start=True))
