"""Finished runs by setting, and the conditions under which they are compared."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import pandas as pd

from bgpo_trl.runs.directory import differing_settings
from bgpo_trl.runs.provenance import each_once
from bgpo_trl.runs.results import OF_KEEPING, OF_SEEDS, Run, read_run

NAMES = {
    "bgpo": "BGPO",
    "clone": "clone, without reward",
    "dist-nll-demonstrations": "Dist-NLL + demonstrations",
    "maml-demonstrations": "MAML + demonstrations",
    "bgpo-experts": "BGPO without demonstrations",
    "dist-nll": "Dist-NLL",
    "maml": "MAML",
    "bgpo-single": "BGPO, one policy",
    "oracle": "DDPG, told the label",
    "oracle-demonstrations": "DDPG, told the label + demonstrations",
    "ddpg": "DDPG, told nothing",
    "fine-tuning": "DDPG, fine-tuned",
    "fine-tuning-demonstrations": "DDPG, fine-tuned + demonstrations",
    "ewc": "DDPG with EWC",
    "ewc-demonstrations": "DDPG with EWC + demonstrations",
    "without-bonus": "one policy, without the intrinsic reward",
    "without-gwr": "one policy, without GWR-B",
    "without-both": "one policy, without both",
    "group-balanced-replay": "one policy + replay balanced by group",
    "demonstrations": "one policy + demonstrations",
    "bgpo-paper": "BGPO as published",
    "dist-nll-paper": "Dist-NLL as published",
    "maml-paper": "MAML as published",
}
"""Names of algorithms and variants in tables and figures, in their order there."""

_USUAL = "practised"  # schedule
# Entries of config.json that belong to an algorithm or to keeping its run. All others, such as
# encoders, starts, and the half of the demonstrations to test on, are conditions of a comparison.
_OF_THE_RUN = ("name", "algorithm", "algorithm_class", *OF_KEEPING)
_OF_THE_SETTING = ("tasks", "task_starts", "schedule", "episodes")


def title_of(run: Run) -> str:
    """Return the name of a run in tables, with the changed hyperparameters."""
    changed = [f"{name} {_short(value)}" for name, value in run.changed.items()]
    return ", ".join([NAMES.get(run.algorithm, run.algorithm), *changed])


@dataclass(frozen=True)
class Setting:
    """Runs of the same tasks, presented in the same way, that are compared with each other."""

    runs: dict[str, Run]
    """By their names in tables."""
    order: str = ""
    """Name of its order of tasks, where another setting has the same tasks in another order."""

    @property
    def first(self) -> Run:
        """A run, for what all have in common."""
        return next(iter(self.runs.values()))

    @property
    def in_sequence(self) -> bool:
        """Whether tasks are presented one after the other."""
        starts = self.first.starts
        return len(starts) > 1 and _rising(starts)

    @property
    def from_start(self) -> bool:
        """Whether all tasks are presented from the start."""
        return not any(self.first.starts)

    @property
    def _more(self) -> list[str]:
        """The schedule by which presented tasks are drawn, if not the usual one, and the order."""
        schedule = self.first.schedule
        return [what for what in (schedule * (schedule != _USUAL), self.order) if what]

    @property
    def title(self) -> str:
        """Title of its tables."""
        number = len(self.first.tasks)
        how = f"from episodes {', '.join(map(str, self.first.starts))}"
        if self.from_start:
            how = "all from the start"
        elif self.in_sequence:
            how = "one after the other"
        return ", ".join([f"{number} task{'s' * (number > 1)}", how, *self._more])

    @property
    def slug(self) -> str:
        """Beginning of its figures' file names."""
        kind = "concurrent" if self.from_start else "continual" if self.in_sequence else "staggered"
        return "-".join([kind, str(len(self.first.tasks)), *self._more]).replace(" ", "-")

    def find(self, like: Run) -> Run | None:
        """Return the first run of the same algorithm with the same hyperparameters as another."""

        def settings(run: Run) -> tuple[str, Any, Any]:
            return run.algorithm, run.changed, run.config.get("algorithm")

        return next((run for run in self.runs.values() if settings(run) == settings(like)), None)


def joined(runs: Iterable[Run]) -> list[Run]:
    """Return runs, of which those that differ only in their seeds are one.

    Runs that share a seed, or were tested at other times, stay apart. A hyperparameter that only
    one run's settings name, since it came with a later version, is passed over, unless it is
    `changed` there.
    """
    groups: list[list[Run]] = []
    for run in runs:
        group = next((group for group in groups if _alike(group[0], run)), None)
        if group is None:
            groups.append([run])
        else:
            group.append(run)
    found: list[Run] = []
    for parts in groups:
        seeds = [seed for run in parts for seed in run.seeds]
        tests = {tuple(run.episodes.tolist()) for run in parts}
        found += [_joined(parts)] if len(tests) == 1 and len({*seeds}) == len(seeds) else parts
    return found


def _alike(run: Run, other: Run) -> bool:
    """Return whether two runs differ in their seeds alone."""
    differing = (
        name
        for name, *values in differing_settings(run.config, other.config)
        if name not in OF_KEEPING and not (name.startswith("algorithm.") and "absent" in values)
    )
    return run.changed == other.changed and not any(differing)


def _joined(parts: list[Run]) -> Run:
    """Return runs of different seeds as one."""
    if len(parts) == 1:
        return parts[0]
    parts = sorted(parts, key=lambda run: run.seeds)
    first, summary = parts[0], dict(parts[0].summary)
    for key in OF_SEEDS:
        values = [run.summary.get(key) for run in parts]
        summary[key] = None if None in values else [v for of_run in values for v in of_run or ()]
    for key in ("commit", "command"):
        summary[key] = each_once(run.summary.get(key) or "" for run in parts)
    tables: dict[str, Any] = {}
    for name in ("tests", "training", "final", "costs"):
        of_runs = [getattr(run, name) for run in parts]
        lacking = any(table is None for table in of_runs)
        tables[name] = None if lacking else pd.concat(of_runs, ignore_index=True)
    config = {**first.config, "seeds": [seed for run in parts for seed in run.seeds]}
    return Run(tuple(run.directory for run in parts), config, summary, **tables)


def read_settings(directories: Sequence[Path]) -> tuple[list[Setting], str]:
    """Read runs and sort them by setting: their tasks, and how these are presented.

    Runs that differ in their seeds alone are joined. Runs that are not finished are left out.

    Returns:
        The settings that have runs, and a line about the runs that were left out, or "".

    Raises:
        ValueError: If a run is damaged, none is finished, or runs of a setting have other
            conditions.
    """
    groups: dict[tuple, list[Run]] = {}
    waiting: list[str] = []
    for run in map(read_run, directories):
        if run.unfinished:
            waiting.append(f"{run.directory} {run.unfinished}")
        else:
            kind = (run.tasks, not any(run.starts), _rising(run.starts), run.schedule)
            groups.setdefault(kind, []).append(run)
    left_out = f"{'; '.join(waiting)}: let them finish" if waiting else ""
    if not groups:
        raise ValueError(left_out or "there are no runs: name a run")
    found = [_setting(joined(runs)) for runs in groups.values()]
    found.sort(key=lambda setting: (len(setting.first.tasks), setting.from_start))
    settings: list[Setting] = []
    for setting in found:
        alike = [other for other in settings if replace(other, order="").slug == setting.slug]
        if alike:
            turned = alike[0].first.tasks[::-1] == setting.first.tasks
            order = "in reverse" if turned else f"order {len(alike) + 1}"
            setting = replace(setting, order=order)
        settings.append(setting)
    return settings, left_out


def _rising(starts: Sequence[int]) -> bool:
    return all(start < end for start, end in pairwise(starts))


def _setting(runs: list[Run]) -> Setting:
    """Return runs of the same tasks as a setting; raise ``ValueError`` if conditions differ."""
    order = {name: place for place, name in enumerate(NAMES)}
    runs = sorted(
        runs,
        key=lambda run: (order.get(run.algorithm, len(order)), bool(run.changed), run.directory),
    )
    for one, other in combinations(runs, 2):
        check_conditions(one, other)
    alike: dict[str, list[Run]] = {}
    for run in runs:
        alike.setdefault(title_of(run), []).append(run)
    named: dict[str, Run] = {}
    for run in runs:
        title = title_of(run)
        if len(others := alike[title]) > 1:
            places = [other.place.resolve() for other in others]
            own = run.place if places.count(run.place.resolve()) == 1 else run.directory
            within = own.resolve().relative_to(os.path.commonpath(places))
            title += f" ({own.name if within == Path() else within})"
        if title in named:
            raise ValueError(f"{run.directory} is given twice: name each run once")
        named[title] = run
    return Setting(named)


def reference_of(setting: Setting, settings: Iterable[Setting]) -> Setting | None:
    """Return the setting with the same tasks from the start, for tasks one after the other.

    None without one.

    Raises:
        ValueError: If its runs have other conditions, beside the order and starts of tasks.
    """
    tasks = set(setting.first.tasks)
    others = (other for other in settings if other.from_start)
    found = next((other for other in others if set(other.first.tasks) == tasks), None)
    if found is None or not setting.in_sequence:
        return None
    # The digest of a bank depends on the order of its tasks.
    turned = setting.first.tasks != found.first.tasks
    check_conditions(setting.first, found.first, (*_OF_THE_SETTING, *["bank"] * turned))
    return found


def check_conditions(run: Run, other: Run, ignored: Sequence[str] = ()) -> None:
    """Check that two runs were made under equal conditions.

    Conditions are all entries of ``config.json`` but those of the algorithm, and the time limit of
    an episode. Entries that only one of them has are passed over.

    Raises:
        ValueError: If conditions differ that are not ``ignored``.
    """
    ours, theirs = _conditions(run), _conditions(other)
    differing = [
        f"{name} ({_short(ours[name])} and {_short(theirs[name])})"
        for name in ours
        if name in theirs and name not in ignored and ours[name] != theirs[name]
    ]
    if differing:
        raise ValueError(
            f"{run.directory} and {other.directory} differ in {', '.join(differing)}: only runs "
            "under equal conditions are compared, name the others apart"
        )


def _conditions(run: Run) -> dict[str, Any]:
    algorithm = run.config.get("algorithm")
    # Stored only by runs that began with logged episodes.
    known = {"logged": None} | {k: v for k, v in run.config.items() if k not in _OF_THE_RUN}
    if isinstance(algorithm, dict) and "max_steps" in algorithm:
        known["max_steps"] = algorithm["max_steps"]
    return known


def _short(value: Any) -> str:
    """Return a value as text; of a digest, the beginning."""
    text = str(value)
    return f"{text[:12]}..." if isinstance(value, str) and len(text) > 60 else text
