"""What ``--resume`` finds in a run's directory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from bgpo_trl.configs import RunConfig
from bgpo_trl.runs.config_file import read_config
from bgpo_trl.runs.directory import holds_run
from bgpo_trl.runs.results import read_json


def as_begun(config: RunConfig, directory: Path, *, keep_eval_every: bool = False) -> RunConfig:
    """Returns a run with the tasks' starts and the evaluations of the shorter one in a directory.

    Args:
        config: The run, of which these depend on its length.
        directory: The run's.
        keep_eval_every: Whether the evaluations are as they are for another reason.
    """
    try:
        there, _ = read_config(directory / "config.json")
    except ValueError:  # which who reads it next will tell
        return config
    at_once = [[start == 0 for start in run.task_starts] for run in (there, config)]
    if at_once[0] != at_once[1]:  # another experiment
        return config
    every = config.eval_every if keep_eval_every else there.eval_every
    return replace(config, task_starts=there.task_starts, eval_every=every)


def is_finished(directory: Path, config: RunConfig) -> bool:
    """Returns whether a directory holds all of a run: training, final tests and figures."""
    try:
        there, _ = read_config(directory / "config.json")
        told = read_json(directory / "summary.json")
    except ValueError:
        return False
    tested = (directory / "final.csv").exists()
    return tested and there == config and told.get("episodes") == config.episodes


def check_resumable(directories: Sequence[Path]) -> None:
    """Makes sure that there is a run in one of some directories, for ``--resume``.

    Raises:
        ValueError: If there is none: the name may be mistyped.
    """
    if not any(holds_run(directory) for directory in directories):
        named = " or ".join(map(str, directories))
        raise ValueError(f"{named} holds no run to resume: check --out, or begin without --resume")
