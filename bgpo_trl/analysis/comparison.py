"""Runs that are compared on equal terms: how they are read, and the scores they are compared on."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bgpo_trl.analysis import metrics
from bgpo_trl.runs.results import Curves, read_curves, read_json, read_rows
from suites import nico

Values = NDArray[np.float64]
# Entries of a config.json that a comparison needs; those of runs that must be alike.
_CONFIG = {"episodes": int, "seeds": list, "task_starts": list}
_TESTS = ("held_out", "eval_every", "eval_episodes", "max_steps")
_TERMS = ("seeds", "tasks", "task_starts", "schedule", *_TESTS)


@dataclass(frozen=True)
class Picture:
    """A figure of learning curves."""

    file: str
    """File name, without suffix."""
    caption: str
    """Subtitle, after the title of its group."""
    runs: tuple[str, ...]
    """Directories of the runs, in the order of the legend."""


@dataclass(frozen=True)
class Group:
    """Runs under equal conditions, compared in one table."""

    title: str
    runs: dict[str, str]
    """Names of the runs, by directory."""
    pictures: tuple[Picture, ...]
    own: tuple[str, ...] = ()
    """Those of the runs that are not the package's, by directory."""


@dataclass(frozen=True)
class Run:
    """Settings, summary and curves of one run."""

    directory: Path
    name: str
    config: dict[str, Any]
    summary: dict[str, Any]
    curves: Curves

    @property
    def tasks(self) -> tuple[str, ...]:
        """Names of the tasks; runs of earlier versions saved none, theirs are the paper's."""
        return _tasks(self.config)

    @property
    def eval_every(self) -> int:
        """Training episodes between tests."""
        return _eval_every(self.config, self.curves)


def setting_of(name: str, settings: Iterable[str]) -> str | None:
    """Return the longest of some settings that the name of a run begins with; None without one.

    Example:
        >>> setting_of("eight-reversed-mine", ["eight", "eight-reversed"])
        'eight-reversed'
    """
    fitting = [setting for setting in settings if name.startswith(f"{setting}-")]
    return max(fitting, key=len, default=None)


def with_own(runs: Path, groups: Mapping[str, Group]) -> dict[str, Group]:
    """Add the other runs in a directory to the groups that their names begin with.

    ``continual-mine`` joins the group ``continual``, under the name ``mine``, and its first figure.
    """
    ours = {name for group in groups.values() for name in group.runs}
    extended = dict(groups)
    for path in sorted(runs.glob("*/eval.csv")):
        name = path.parent.name
        key = setting_of(name, groups)
        if name not in ours and key is not None:
            group = extended[key]
            first, *others = group.pictures
            extended[key] = replace(
                group,
                runs={**group.runs, name: name.removeprefix(f"{key}-")},
                pictures=(replace(first, runs=(*first.runs, name)), *others),
                own=(*group.own, name),
            )
    return extended


def _tasks(config: dict[str, Any]) -> tuple[str, ...]:
    return tuple(config.get("tasks") or nico.PAPER_TASKS)


def read_group(runs: Path, group: Group) -> tuple[dict[str, Run], list[str]]:
    """Read the runs of a group in a directory and cut them to a common length.

    Returns:
        The runs found, by directory name, and notes on missing, unfinished or cut runs. Runs
        without a test of their last task are left out, as are own runs that were trained or tested
        otherwise than the first run.

    Raises:
        ValueError: If the package's runs of the group differ in seeds, tasks, task starts, test
            episodes or the time limit of an episode.
    """
    found: dict[str, Run] = {}
    notes: list[str] = []
    for key, name in group.runs.items():
        directory = runs / key
        if not (directory / "eval.csv").exists() or not read_rows(directory / "eval.csv"):
            notes.append(f"{name}: missing ({key}/eval.csv is not there, or empty)")
            continue
        config = read_json(directory / "config.json", _CONFIG)
        path = directory / "summary.json"
        summary = read_json(path) if path.exists() else {}
        curves = read_curves(directory / "eval.csv", _tasks(config))
        if np.isnan(curves.success[:, -1]).any():
            episode = curves.episodes[-1]
            notes.append(f"{name}: left out, no test of some task at episode {episode}")
            continue
        if config["episodes"] - int(curves.episodes[-1]) >= _eval_every(config, curves):
            notes.append(
                f"{name}: not finished, {curves.episodes[-1]} of {config['episodes']} episodes"
            )
        found[key] = Run(directory, name, config, summary, curves)
    if not found:
        return found, [f"missing: {', '.join(group.runs)}"]
    first = next(iter(found.values()))
    for key, run in list(found.items()):
        other = _other_terms(run, first)
        if other and key not in group.own:
            raise ValueError(f"{other}: only runs on equal terms are compared")
        if other:
            notes.append(f"{run.name}: left out, since {other}")
            del found[key]
    last = min(int(run.curves.episodes[-1]) for run in found.values())
    for key, run in found.items():
        if run.curves.episodes[-1] > last:
            notes.append(f"{run.name}: cut at {last} of {run.curves.episodes[-1]} episodes")
        found[key] = replace(run, curves=run.curves.until(last))
    return found, notes


def _other_terms(run: Run, first: Run) -> str:
    """Return in what a run was trained or tested otherwise than the first; "" if in nothing."""
    for what in _TERMS:
        ours, theirs = (_terms(of).get(what) for of in (run, first))
        if ours != theirs and None not in (ours, theirs):
            return f"{run.directory} has {what} {ours}, {first.directory} has {theirs}"
    return ""


def _eval_every(config: dict[str, Any], curves: Curves) -> int:
    tested = [0, *curves.episodes.tolist()]
    return config.get("eval_every") or min(after - before for before, after in pairwise(tested))


def _terms(run: Run) -> dict[str, Any]:
    limit = {"max_steps": (run.config.get("algorithm") or {}).get("max_steps")}
    practised = {"schedule": "practised"}  # in all runs of earlier versions
    return {**practised, **run.config, **limit, "tasks": run.tasks}


def starts(run: Run) -> list[int]:
    """Return the episode from which each task is presented."""
    return run.config["task_starts"]


def late_scores(run: Run) -> Values:
    """Return the mean success over the last 10 % of training, ``[S, T]``."""
    return success_at(run, [int(run.curves.episodes[-1])])[:, 0]


def success_at(run: Run, ends: Sequence[int]) -> Values:
    """Return the mean success over the 10 % of training before some episodes, ``[S, P, T]``."""
    episodes = run.curves.episodes
    window = max(run.eval_every, round(0.1 * int(episodes[-1])))
    return metrics.evaluation_matrix(run.curves.success, episodes, ends, window=window)


def area_scores(run: Run) -> Values:
    """Return the area under each task's curve since its presentation, ``[S, T]``."""
    episodes, areas = run.curves.episodes, []
    for task, start in enumerate(starts(run)):
        since = episodes > start
        curve = run.curves.success[:, since, task]
        areas.append(metrics.area_under_curve(curve, episodes[since] - start))
    return np.stack(areas, axis=-1)
