"""What runs are compared, on which measures, and what the paper claims about them."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bgpo_trl import metrics
from bgpo_trl.runs import Curves, read_curves, read_json, read_rows
from suites import nico

Values = NDArray[np.float64]
Table = list[list[str]]
"""Rows of cells, the head first."""


@dataclass(frozen=True)
class Group:
    """Runs that one figure compares."""

    figure: str
    """Number of the figure in the paper."""
    title: str
    runs: dict[str, str]
    """What a run is called, by the name of its directory."""


REFERENCES = {"oracle": "DDPG, told the label", "ddpg": "DDPG, told nothing"}
ALGORITHMS = {"bgpo": "BGPO", "maml": "MAML", "dist-nll": "Dist-NLL", **REFERENCES}
GROUPS = {
    "concurrent": Group(
        "6",
        "All tasks from the start",
        {f"concurrent-{key}": name for key, name in ALGORITHMS.items()},
    ),
    "continual": Group(
        "8",
        "Tasks one after the other",
        {f"continual-{key}": name for key, name in ALGORITHMS.items()},
    ),
    "ablation": Group(
        "9",
        "What GWR-B and the intrinsic reward contribute",
        {
            "concurrent-bgpo": "GWR-B + r_int",
            "ablation-gwr": "GWR-B",
            "ablation-r_int": "r_int",
            "ablation-none": "none",
            **{f"concurrent-{key}": name for key, name in REFERENCES.items()},
        },
    ),
}


@dataclass(frozen=True)
class Run:
    """One run, as its files tell it."""

    directory: Path
    name: str
    config: dict[str, Any]
    summary: dict[str, Any]
    curves: Curves


def read_group(runs: Path, group: Group) -> tuple[dict[str, Run], list[str]]:
    """Reads the runs of a group and cuts them to a common length.

    Args:
        runs: Directory of the runs.
        group: What to read.

    Returns:
        The runs that are there, by the names of their directories; and notes about those that are
        missing, not finished or cut.

    Raises:
        ValueError: If runs of a figure have other seeds, tasks or states than each other.
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
        curves = read_curves(directory / "eval.csv", nico.ALL_TASKS)
        if int(curves.episodes[-1]) < config["episodes"]:
            notes.append(
                f"{name}: not finished, {curves.episodes[-1]} of {config['episodes']} episodes"
            )
        found[key] = Run(directory, name, config, summary, curves)
    if not found:
        return found, notes
    first = next(iter(found.values()))
    last = min(int(run.curves.episodes[-1]) for run in found.values())
    for key, run in found.items():
        for what in ("seeds", "task_starts"):
            if run.config[what] != first.config[what]:
                raise ValueError(
                    f"{run.directory} has {what} {run.config[what]}, {first.directory} has "
                    f"{first.config[what]}: only runs on equal terms are compared"
                )
        if run.curves.episodes[-1] > last:
            notes.append(f"{run.name}: cut at {last} of {run.curves.episodes[-1]} episodes")
        found[key] = replace(run, curves=run.curves.until(last))
    return found, notes


def starts(run: Run) -> list[int]:
    """Returns the episode from which each task is presented."""
    return run.config["task_starts"]


def late_scores(run: Run) -> Values:
    """Returns success over the last 10 % of training, ``[S, T]``."""
    episodes = run.curves.episodes
    last = int(episodes[-1])
    window = max(1, round(0.1 * last))
    return metrics.evaluation_matrix(run.curves.success, episodes, [last], window=window)[:, 0]


def area_scores(run: Run) -> Values:
    """Returns the area under each task's curve from its presentation on, ``[S, T]``."""
    return np.stack(
        [task_area(run, task, start) for task, start in enumerate(starts(run))], axis=-1
    )


def task_area(run: Run, task: int, start: int, length: int | None = None) -> Values:
    """Returns the area under a task's curve over the episodes after a start, ``[S]``.

    Args:
        run: The run.
        task: Which task.
        start: Episode from which on it is counted.
        length: For how many episodes; to the end of training if None.
    """
    episodes = run.curves.episodes
    chosen = episodes > start
    if length is not None:
        chosen &= episodes <= start + length
    return metrics.area_under_curve(run.curves.success[:, chosen, task], episodes[chosen] - start)


def episodes_to_80(run: Run) -> float:
    """Returns when the mean over seeds and presented tasks first stays at 80 % for 3 tests."""
    mean = metrics.presented_mean(metrics.trailing_mean(run.curves.success, 3)).mean(0)
    return float(metrics.episodes_to(mean, run.curves.episodes))


class Statistics:
    """Statistics with intervals; those of a run do not depend on which others are there.

    Args:
        seed: Of the resampling.
    """

    def __init__(self, seed: int = 0) -> None:
        self._seed = seed
        self._drawn: dict[bytes, Values] = {}

    def resampled(self, scores: Values) -> Values:
        """Returns the interquartile mean of resampled scores."""
        key = scores.tobytes()
        if key not in self._drawn:
            rng = np.random.default_rng([self._seed, zlib.crc32(key)])
            self._drawn[key] = metrics.stratified_bootstrap(scores, rng=rng)
        return self._drawn[key]

    def cell(self, scores: Values) -> str:
        """Returns an interquartile mean with its interval, in per cent."""
        low, high = metrics.percentile_interval(self.resampled(scores))
        middle = metrics.interquartile_mean(scores)
        return f"{100 * middle:.1f} [{100 * low:.0f}, {100 * high:.0f}]"


def main_table(runs: dict[str, Run], statistics: Statistics) -> Table:
    """Returns the rows of a group's table, its head first."""
    rows = [["", "last 10 %: IQM", "mean", *(f"task {i + 1}" for i in range(3)), "area: IQM"]]
    rows[0].append("episodes to 80 %")
    for run in runs.values():
        late, reached = late_scores(run), episodes_to_80(run)
        rows.append(
            [
                run.name,
                statistics.cell(late),
                f"{100 * late.mean():.1f}",
                *(f"{100 * share:.0f}" for share in late.mean(0)),
                statistics.cell(area_scores(run)),
                f"{reached:.0f}" if np.isfinite(reached) else "not reached",
            ]
        )
    return rows


def continual_table(continual: dict[str, Run], concurrent: dict[str, Run]) -> Table:
    """Returns forgetting and transfer of the continual runs, the table's head first."""
    rows = [["", "forgotten since learned", "forgotten since best", "backward", "forward"]]
    for key, run in continual.items():
        success, episodes = run.curves.success, run.curves.episodes
        ends = [*starts(run)[1:], int(episodes[-1])]
        matrix = metrics.evaluation_matrix(
            success, episodes, ends, window=max(1, round(0.1 * episodes[-1]))
        )
        best = metrics.forgetting_since_best(metrics.trailing_mean(success, 3))
        cells = [
            _spread(metrics.forgetting_since_learned(matrix)),
            _spread(best),
            _spread(metrics.backward_transfer(matrix)),
        ]
        beside = concurrent.get(key.replace("continual", "concurrent"))
        rows.append([run.name, *cells, "" if beside is None else _forward(run, beside)])
    return rows


def _forward(run: Run, beside: Run) -> str:
    gains = []
    for task, start in enumerate(starts(run)):
        if start == 0:
            continue
        length = int(min(run.curves.episodes[-1] - start, beside.curves.episodes[-1]))
        reference = task_area(beside, task, 0, length).mean()
        gains.append(metrics.forward_transfer(task_area(run, task, start, length), reference))
    return _spread(np.mean(gains, axis=0))


def _spread(values: Values) -> str:
    return f"{100 * values.mean():.1f} ± {100 * values.std():.1f}"


def claims(groups: dict[str, dict[str, Run]], statistics: Statistics) -> Table:
    """Returns the paper's claims with what was found, the table's head first."""
    rows = [["the paper's claim", "measured", "difference [95 %]", "found"]]

    def compare(claim: str, what: str, first: Run | None, second: Run | None) -> None:
        if first is None or second is None:
            rows.append([claim, what, "", "a run is missing"])
            return
        scores = late_scores if what == "last 10 %" else area_scores
        ours, theirs = scores(first), scores(second)
        gain = metrics.interquartile_mean(ours) - metrics.interquartile_mean(theirs)
        drawn = statistics.resampled(ours) - statistics.resampled(theirs)
        rows.append([claim, what, *_verdict(gain, drawn)])

    for setting in ("concurrent", "continual"):
        runs = groups[setting]
        for rival in ("maml", "dist-nll"):
            for what in ("last 10 %", "area"):
                compare(
                    f"BGPO above {ALGORITHMS[rival]}, {setting}",
                    what,
                    runs.get(f"{setting}-bgpo"),
                    runs.get(f"{setting}-{rival}"),
                )
    for rival in ("maml", "dist-nll"):
        rows.append(_gap_claim(groups, rival, statistics))
    ablation = groups["ablation"]
    order = ["concurrent-bgpo", "ablation-gwr", "ablation-r_int", "ablation-none"]
    for better, worse in [*pairwise(order), (order[0], order[-1])]:
        names = GROUPS["ablation"].runs
        compare(
            f"{names[better]} converges faster than {names[worse]}",
            "area",
            ablation.get(better),
            ablation.get(worse),
        )
    return rows


def _gap_claim(groups: dict[str, dict[str, Run]], rival: str, statistics: Statistics) -> list[str]:
    claim = f"the gap to {ALGORITHMS[rival]} is larger in the continual setting"
    needed = [
        groups[setting].get(f"{setting}-{key}")
        for setting in ("continual", "concurrent")
        for key in ("bgpo", rival)
    ]
    runs = [run for run in needed if run is not None]
    if len(runs) < len(needed):
        return [claim, "last 10 %", "", "a run is missing"]
    scores = [late_scores(run) for run in runs]
    middle = [metrics.interquartile_mean(s) for s in scores]
    drawn = [statistics.resampled(s) for s in scores]
    gain = (middle[0] - middle[1]) - (middle[2] - middle[3])
    return [
        claim,
        "last 10 %",
        *_verdict(gain, (drawn[0] - drawn[1]) - (drawn[2] - drawn[3])),
    ]


def _verdict(gain: float, drawn: Values) -> list[str]:
    low, high = metrics.percentile_interval(drawn)
    found = "reproduced" if low > 0 else "the opposite" if high < 0 else "not decided"
    return [f"{100 * gain:+.1f} [{100 * low:+.0f}, {100 * high:+.0f}]", found]
