"""State of a run directory, as ``--resume`` reads it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from bgpo_trl.configs import RunConfig
from bgpo_trl.runs.config_file import read_config
from bgpo_trl.runs.results import read_json


def as_begun(config: RunConfig, directory: Path, *, keep_eval_every: bool = False) -> RunConfig:
    """Return a run with the task starts and evaluation interval of the shorter run in a directory.

    Args:
        config: The run; both settings depend on its length by default.
        directory: The run directory.
        keep_eval_every: Whether to keep the evaluation interval of ``config``.
    """
    try:
        saved, _ = read_config(directory / "config.json")
    except ValueError:  # reported by the next reader of the file
        return config
    at_once = [[start == 0 for start in run.task_starts] for run in (saved, config)]
    if at_once[0] != at_once[1]:  # another experiment
        return config
    every = config.eval_every if keep_eval_every else saved.eval_every
    return replace(config, task_starts=saved.task_starts, eval_every=every)


def is_finished(directory: Path, config: RunConfig) -> bool:
    """Return whether a directory holds a complete run: training, final tests and figures."""
    try:
        saved, _ = read_config(directory / "config.json")
        summary = read_json(directory / "summary.json")
    except ValueError:
        return False
    tested = (directory / "final.csv").exists()
    return tested and saved == config and summary.get("episodes") == config.episodes
