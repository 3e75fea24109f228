"""Benchmark of the suite's eight tasks: its runs, and one row of measures for each.

The measures are those of Continual World (Wolczyk et al., 2021) and COOM (Tomilin et al., 2023),
with the differences that ``docs/benchmark.md`` lists.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np

from bgpo_trl.analysis import metrics, paper_runs
from bgpo_trl.analysis.comparison import (
    Group,
    Picture,
    Run,
    Values,
    late_scores,
    setting_of,
    starts,
)
from bgpo_trl.analysis.intervals import Statistics, means, percent_cell
from bgpo_trl.analysis.tables import Table
from bgpo_trl.analysis.transfer import forward_transfer
from bgpo_trl.runs.cost import Cost, read_costs

ALGORITHMS = {
    "bgpo": "BGPO",
    "bgpo-encoders-of-three": "BGPO, encoders of three tasks",
    "maml-demonstrations": "MAML + demonstrations",
    "dist-nll-demonstrations": "Dist-NLL + demonstrations",
    "bgpo-experts": "BGPO without demonstrations",
    "bgpo-single": "BGPO, one policy",
    "maml": "MAML",
    "dist-nll": "Dist-NLL",
    "oracle": "DDPG, told the label",
}
CONCURRENT = "eight-concurrent"
"""Key of the runs that serve as references of forward transfer."""
SEQUENCES = {
    "eight": "one after the other",
    "eight-reversed": "one after the other, in reverse",
}
NOTES: tuple[str, ...] = (
    "Means and 95 % intervals over seeds, in points; performance: mean success over the last 10 % "
    "of training. BGPO's lead: its performance minus the row's.",
    "Forgetting: success at the end of a task's own phase minus that at the end of training, mean "
    "over all tasks; backward transfer: the negative, without the last task.",
    "Forward transfer: (area - reference) / (1 - reference), areas under a task's curve over its "
    "own episodes, from the first to the last test of its phase; reference: the same algorithm "
    "with all tasks from the start, its seeds resampled too.",
    "Nodes and groups: means over seeds. Hours and megabytes (replay, networks, GWR-B): of all "
    "seeds together, without tests.",
)


def _group(key: str, title: str) -> Group:
    shown = ("bgpo", "bgpo-encoders-of-three", "maml-demonstrations", "dist-nll-demonstrations")
    alone = ("bgpo-experts", "bgpo-single", "maml", "dist-nll")

    def picture(file: str, caption: str, algorithms: tuple[str, ...]) -> Picture:
        return Picture(file, caption, tuple(f"{key}-{name}" for name in (*algorithms, "oracle")))

    return Group(
        f"Eight tasks, {title}",
        {f"{key}-{name}": about for name, about in ALGORITHMS.items()},
        (
            picture(key, "with demonstrations as experience", shown),
            picture(f"{key}-without", "without demonstrations as experience", alone),
        ),
    )


GROUPS = {key: _group(key, title) for key, title in SEQUENCES.items()}
GROUPS[CONCURRENT] = _group(CONCURRENT, "all from the start")


def knows_label(run: Run) -> bool | None:
    """Return whether the algorithm of a run is told the task's label; None if it is not said.

    Runs record it as ``needs_label`` in ``summary.json``; without that entry, the algorithm's name
    decides.
    """
    if "needs_label" in run.summary:
        return bool(run.summary["needs_label"])
    name = run.config.get("name", "")
    if name.startswith(("maml", "dist-nll", "oracle")):
        return True
    return False if name in ALGORITHMS | paper_runs.ALGORITHMS | paper_runs.PUBLISHED else None


def success_matrix(run: Run) -> Values:
    """Return ``R[i, j]``, the success on task j at the end of phase i, ``[S, T, T]``.

    Success is the mean over the last fifth of a phase, at least one evaluation; NaN for tasks that
    have not been presented.

    Raises:
        ValueError: If tasks do not start one after the other, or a phase has no evaluation.
    """
    begun, last = starts(run), int(run.curves.episodes[-1])
    lengths = [end - start for start, end in pairwise([*begun, last])]
    if min(lengths) <= 0:
        raise ValueError(
            f"{run.directory} starts its tasks at {begun}: name runs of tasks that do not start "
            f"one after the other {CONCURRENT}-ALGORITHM"
        )
    window = max(run.eval_every, min(lengths) // 5)
    matrix = metrics.evaluation_matrix(
        run.curves.success, run.curves.episodes, [*begun[1:], last], window=window
    )
    if np.isnan(np.diagonal(matrix, axis1=-2, axis2=-1)).any():
        raise ValueError(
            f"{run.directory} has a phase of {min(lengths)} episodes without a test of its task: "
            "evaluate more often than once a phase"
        )
    return matrix


def benchmark_table(
    runs: Mapping[str, Run], references: Mapping[str, Run], statistics: Statistics
) -> Table:
    """Return the table of the benchmark, one row for each run of a sequence; see `NOTES`.

    Args:
        runs: Runs by directory name.
        references: Runs with all tasks from the start, by directory name.
        statistics: Of the intervals.
    """
    rows = [["", "knows the label", "performance", "BGPO's lead", "forgetting"]]
    rows[0] += ["backward transfer", "forward transfer", "nodes", "groups", "hours", "megabytes"]
    ours = next((runs[key] for key in runs if _algorithm(key) == "bgpo"), None)
    for key, run in runs.items():
        scores, lead = late_scores(run), "-"
        if ours is not None and run is not ours:
            lead = statistics.difference(late_scores(ours), scores, statistic=means).cell()
        matrix = success_matrix(run)
        reference = references.get(f"{CONCURRENT}-{_algorithm(key)}")
        transfer = "-"
        if reference is not None:
            transfer = percent_cell(*forward_transfer(run, reference, statistics))
        costs = _costs(run)
        hours = sum(cost.seconds for cost in costs.values()) / 3600
        rows.append(
            [
                run.name,
                {True: "yes", False: "no", None: "?"}[knows_label(run)],
                statistics.cell(scores, means),
                lead,
                statistics.cell(-metrics.change_since_learned(matrix), means),
                statistics.cell(metrics.backward_transfer(matrix), means),
                transfer,
                *(_mean_number(run.summary.get(what)) for what in ("nodes", "groups")),
                f"{hours:.1f}" if costs else "-",
                f"{max(cost.megabytes for cost in costs.values()):.0f}" if costs else "-",
            ]
        )
    return rows


def _algorithm(name: str) -> str:
    """Return the algorithm in the name of a sequence's run."""
    return name.removeprefix(f"{setting_of(name, SEQUENCES)}-")


def cost_table(runs: Mapping[str, Run]) -> Table:
    """Return the table of the cost of a training step by the number of presented tasks.

    Empty if no run has a ``cost.csv``.
    """
    costs = {run.name: of_run for run in runs.values() if (of_run := _costs(run))}
    numbers = sorted({tasks for of_run in costs.values() for tasks in of_run})
    rows = [["", *(f"{number} task{'s' * (number > 1)}" for number in numbers)]]
    for name, of_run in costs.items():
        rows.append([name, *(_cost_cell(of_run.get(number)) for number in numbers)])
    return rows if costs else []


def _cost_cell(cost: Cost | None) -> str:
    if cost is None or not cost.steps:
        return "-"
    return f"{1000 * cost.seconds / cost.steps:.1f} ms, {cost.megabytes:.0f} MB"


def _costs(run: Run) -> dict[int, Cost]:
    path = run.directory / "cost.csv"
    return read_costs(path) if path.exists() else {}


def _mean_number(of_seeds: list[float] | None) -> str:
    return "-" if of_seeds is None else f"{np.mean(of_seeds):.1f}".removesuffix(".0")
