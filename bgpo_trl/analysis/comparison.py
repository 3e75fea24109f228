"""Runs to compare, their groups and figures, and the scores they are compared on."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bgpo_trl.analysis import intervals, metrics
from bgpo_trl.runs.results import Curves, read_curves, read_json, read_rows
from suites import nico

Values = NDArray[np.float64]
Statistic = Callable[[Values], Values]
"""Maps samples of scores, ``[N, S, T]``, to a value of each, ``[N]``."""
IQM: Statistic = intervals.interquartile_means


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


REFERENCES = {"oracle": "DDPG, told the label", "ddpg": "DDPG, told nothing"}
ALGORITHMS = {
    "bgpo": "BGPO",
    "bgpo-experts": "BGPO without demonstrations",
    "bgpo-single": "BGPO, one policy",
    "maml": "MAML",
    "maml-demonstrations": "MAML + demonstrations",
    "dist-nll": "Dist-NLL",
    "dist-nll-demonstrations": "Dist-NLL + demonstrations",
    **REFERENCES,
}
PUBLISHED = {
    "bgpo-paper": "BGPO as published",
    "maml-paper": "MAML as published",
    "dist-nll-paper": "Dist-NLL as published",
}
SETTINGS = {
    "concurrent": ("6", "all tasks from the start"),
    "continual": ("8", "tasks one after the other"),
}
"""Number of the paper's figure, and its schedule of tasks."""
# Variants that are also algorithms, run once under the algorithm's name.
SAME = {"gwr+r_int": "bgpo-single", "experts": "bgpo-experts", "all": "bgpo"}
PUBLISHED_VARIANTS = {
    "gwr+r_int": "GWR-B + r_int",
    "gwr": "GWR-B",
    "r_int": "r_int",
    "none": "none",
}
ADDITIONS = {
    "gwr+r_int": "GWR-B + r_int",
    "even-replay": "+ even replay",
    "experts": "+ even replay + experts",
    "demonstrations": "+ demonstrations",
    "all": "+ all three",
}


def variant(setting: str, name: str) -> str:
    """Return the directory of a variant's run."""
    if name in SAME:
        return f"{setting}-{SAME[name]}"
    return f"ablation-{name}" if setting == "concurrent" else f"ablation-continual-{name}"


def _compared(setting: str) -> Group:
    number, title = SETTINGS[setting]
    alone = ("bgpo-experts", "maml", "dist-nll", *REFERENCES, "bgpo-single")
    shown = ("bgpo", "maml-demonstrations", "dist-nll-demonstrations", *REFERENCES)

    def picture(file: str, caption: str, algorithms: tuple[str, ...]) -> Picture:
        return Picture(file, caption, tuple(f"{setting}-{key}" for key in algorithms))

    return Group(
        f"Fig. {number}: {title}",
        {f"{setting}-{key}": name for key, name in ALGORITHMS.items()},
        (
            picture(f"fig{number}", "with demonstrations as experience", shown),
            picture(f"fig{number}-without", "without demonstrations as experience", alone),
        ),
    )


def _published(setting: str) -> Group:
    number, title = SETTINGS[setting]
    runs = {f"{setting}-{key}": name for key, name in PUBLISHED.items()}
    picture = Picture(f"fig{number}-published", "no stabilizers, small networks", tuple(runs))
    return Group(f"Fig. {number} as published: {title}", runs, (picture,))


def _ablation(setting: str) -> Group:
    published = {variant(setting, key): name for key, name in PUBLISHED_VARIANTS.items()}
    added = {variant(setting, key): name for key, name in ADDITIONS.items()}
    references = {f"{setting}-{key}": name for key, name in REFERENCES.items()}
    file = "fig9" if setting == "concurrent" else f"fig9-{setting}"
    return Group(
        f"Fig. 9: contribution of each part, {SETTINGS[setting][1]}",
        {**published, **added, **references},
        (
            Picture(file, "the paper's four", (*published, *references)),
            Picture(f"{file}-added", "additions to them", tuple(added)),
        ),
    )


GROUPS = {setting: _compared(setting) for setting in SETTINGS}
GROUPS |= {f"{setting}-paper": _published(setting) for setting in SETTINGS}
GROUPS |= {"ablation": _ablation("concurrent"), "ablation-continual": _ablation("continual")}


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
        """Training episodes between tests; 1, the least, if the run does not say."""
        return self.config.get("eval_every", 1)


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
            )
    return extended


def _tasks(config: dict[str, Any]) -> tuple[str, ...]:
    return tuple(config.get("tasks") or nico.PAPER_TASKS)


def read_group(runs: Path, group: Group) -> tuple[dict[str, Run], list[str]]:
    """Read the runs of a group in a directory and cut them to a common length.

    Returns:
        The runs found, by directory name, and notes on missing, unfinished or cut runs. Runs
        without a test of their last task are left out.

    Raises:
        ValueError: If runs of the group differ in seeds, tasks, task starts, test episodes or the
            time limit of an episode.
    """
    found: dict[str, Run] = {}
    notes: list[str] = []
    for key, name in group.runs.items():
        directory = runs / key
        if not (directory / "eval.csv").exists() or not read_rows(directory / "eval.csv"):
            notes.append(f"{name}: missing ({key}/eval.csv is not there, or empty)")
            continue
        config = read_json(directory / "config.json")
        path = directory / "summary.json"
        summary = read_json(path) if path.exists() else {}
        curves = read_curves(directory / "eval.csv", _tasks(config))
        if np.isnan(curves.success[:, -1]).any():
            episode = curves.episodes[-1]
            notes.append(f"{name}: left out, no test of some task at episode {episode}")
            continue
        if int(curves.episodes[-1]) < config["episodes"]:
            notes.append(
                f"{name}: not finished, {curves.episodes[-1]} of {config['episodes']} episodes"
            )
        found[key] = Run(directory, name, config, summary, curves)
    if not found:
        return found, [f"missing: {', '.join(group.runs)}"]
    first = next(iter(found.values()))
    last = min(int(run.curves.episodes[-1]) for run in found.values())
    for key, run in found.items():
        for what in ("seeds", "tasks", "task_starts", "held_out", "eval_episodes", "max_steps"):
            ours, theirs = (_terms(of).get(what) for of in (run, first))
            if ours != theirs and None not in (ours, theirs):
                raise ValueError(
                    f"{run.directory} has {what} {ours}, {first.directory} has {theirs}: only runs "
                    "on equal terms are compared"
                )
        if run.curves.episodes[-1] > last:
            notes.append(f"{run.name}: cut at {last} of {run.curves.episodes[-1]} episodes")
        found[key] = replace(run, curves=run.curves.until(last))
    return found, notes


def _terms(run: Run) -> dict[str, Any]:
    limit = {"max_steps": (run.config.get("algorithm") or {}).get("max_steps")}
    return {**run.config, **limit, "tasks": run.tasks}


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


class Statistics:
    """Bootstrap statistics; each set of scores has its own stream of random numbers.

    Intervals of a run thus do not depend on the other runs.
    """

    def __init__(self, seed: int = 0) -> None:
        self._seed = seed
        self._drawn: dict[tuple[Statistic, bytes], Values] = {}

    def resampled(self, scores: Values, statistic: Statistic = IQM) -> Values:
        """Return a statistic of resampled scores, by default interquartile means."""
        key = scores.tobytes()
        if (statistic, key) not in self._drawn:
            rng = np.random.default_rng([self._seed, zlib.crc32(key)])
            drawn = intervals.stratified_bootstrap(scores, statistic, rng=rng)
            self._drawn[statistic, key] = drawn
        return self._drawn[statistic, key]

    def cell(self, scores: Values, statistic: Statistic = IQM) -> str:
        """Format a statistic of scores with its interval, in percent."""
        low, high = intervals.percentile_interval(self.resampled(scores, statistic))
        (middle,) = statistic(scores[None])
        return f"{_percent(middle, 1)} [{_percent(low, 0)}, {_percent(high, 0)}]"

    def difference(self, *scores: Values, statistic: Statistic = IQM) -> Difference:
        """Return the difference of a statistic between two runs' scores, with its interval.

        Of four runs: the difference between the first two minus that between the last two.
        """
        gain = _difference([float(statistic(of_run[None])[0]) for of_run in scores])
        drawn = _difference([self.resampled(of_run, statistic) for of_run in scores])
        return Difference(gain, *intervals.percentile_interval(drawn))


class Difference(NamedTuple):
    """A difference of success between runs, and its 95 % interval."""

    gain: float
    low: float
    high: float

    def cell(self) -> str:
        """Format the difference and its interval, in points."""
        return f"{100 * self.gain:+.1f} [{100 * self.low:+.0f}, {100 * self.high:+.0f}]"


def _difference(values: list[Any]) -> Any:
    gap = values[0] - values[1]
    return gap if len(values) == 2 else gap - (values[2] - values[3])


def _percent(share: float, digits: int) -> str:
    # Adding 0 turns -0.0 into 0.0.
    return f"{round(100 * share, digits) + 0.0:.{digits}f}"
