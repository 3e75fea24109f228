"""Tables and figures of finished runs.

    python benchmarks/summary.py runs/continual-*

prints a table of success by task for each run, and redraws ``success.png`` and, for runs with
groups of behaviors, ``groups.png``.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from types import NoneType
from typing import Annotated, Any

import numpy as np
import tyro

from bgpo_trl.analysis.metrics import overall_episodes_to
from bgpo_trl.analysis.tables import median_cell, own_episodes, ratio_cells
from bgpo_trl.figures.curves import plot_success_curves
from bgpo_trl.figures.of_run import draw_groups
from bgpo_trl.figures.style import save_figure
from bgpo_trl.runs.cost import Cost, read_costs
from bgpo_trl.runs.results import (
    count,
    read_curves,
    read_final_tests,
    read_json,
    read_rows,
    read_tests,
)
from suites import nico


@dataclass(frozen=True)
class Arguments:
    """Summarize the directories of runs."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Run directories; without final tests, those columns stay empty."""


def summarize(path: Path) -> dict[str, float]:
    """Return success over the last 10 % of training, by task and overall, and episodes to 80 %.

    Args:
        path: An ``eval.csv`` with test episodes of every task.

    Returns:
        Success by task; ``overall``, the mean over tasks; and ``episodes to 80 %``, the result of
        `overall_episodes_to`, infinite if not reached.

    Raises:
        ValueError: If a task has no test in that period.
    """
    rows = read_tests(path)
    late = defaultdict(list)
    for row in _late(rows):
        late[row["task"]].append(float(row["success"]))
    for task in _tasks(rows):
        if not late[task]:
            raise ValueError(f"{path} has no late test of {task!r}: let the run finish")
    table = {task: float(np.mean(late[task])) for task in _tasks(rows)}
    table["overall"] = sum(table.values()) / len(table)
    curves = read_curves(path, _tasks(rows))
    table["episodes to 80 %"] = overall_episodes_to(curves.success, curves.episodes)
    return table


def best(path: Path) -> dict[str, float]:
    """Return each task's highest mean success over seeds during any 10 % of training.

    Args:
        path: An ``eval.csv``.
    """
    rows = read_tests(path)
    window = max(int(row["episode"]) for row in rows) / 10
    found = {}
    for task in _tasks(rows):
        tests = [(int(r["episode"]), float(r["success"])) for r in rows if r["task"] == task]
        episode, success = np.array(tests).T
        ends = [end for end in np.unique(episode) if end >= episode.min() + window - 1]
        found[task] = max(
            float(success[(episode > end - window) & (episode <= end)].mean())
            for end in ends or [episode.max()]
        )
    return found


def lengths(path: Path) -> dict[str, float]:
    """Return the mean length of each task's successful tests over the last 10 % of training.

    Args:
        path: An ``eval.csv``. Tasks without a success, or without lengths, are left out.
    """
    steps = defaultdict(list)
    for row in _late(read_tests(path)):
        if float(row["success"]) == 1 and row.get("steps"):
            steps[row["task"]].append(int(row["steps"]))
    return {task: float(np.mean(each)) for task, each in steps.items()}


def describe(run: Path) -> str:
    """Return the table of a run in Markdown."""
    late, highest = summarize(run / "eval.csv"), best(run / "eval.csv")
    final, summary = _measured(run)

    def trained(task: str | None, kind: str, column: str, digits: int) -> str:
        if final is None:
            return ""
        cells = [
            row[column]
            for row in final
            if row["task"] == (task or row["task"]) and row["demonstrations"] == kind
        ]
        if not cells:
            named = f"{task!r} with {kind} demonstrations"
            raise ValueError(
                f"{run / 'final.csv'} has no test of {named}: remove it and resume the run"
            )
        if "" in cells:  # task inference of an algorithm without GWR-B
            return ""
        return f"{100 * np.mean([float(cell) for cell in cells]):.{digits}f}"

    lines = [
        "| task | last 10 % | best 10 % | by seed | own episodes to 50 % | trained, seen "
        "| trained, held-out | inferred | steps to success |",
        "|---|---:|---:|---|---:|---:|---:|---:|---:|",
    ]
    by_seed, steps = _late_by_seed(run / "eval.csv"), lengths(run / "eval.csv")
    tasks = [task for task in by_seed if task]
    own = own_episodes(run / "train.csv", tasks)
    for task in by_seed:
        numbers = [late[task or "overall"], *([highest[task]] if task else [])]
        cells = [f"{100 * number:.1f}" for number in numbers] + ([] if task else [""])
        cells.append(" ".join(f"{100 * success:.0f}" for success in by_seed[task]))
        cells.append("" if own is None or task is None else median_cell(own[:, tasks.index(task)]))
        cells += [trained(task, kind, "success", 1) for kind in ("seen", "held-out")]
        cells.append(trained(task, "held-out", "task_inference", 2))
        cells.append(f"{steps[task]:.1f}" if task in steps else "")
        lines.append(f"| {task or 'all'} | " + " | ".join(cells) + " |")
    reached = late["episodes to 80 %"]
    facts = []
    # Among tasks one after the other, the first would be counted alone.
    if not any(read_json(run / "config.json").get("task_starts") or ()):
        facts.append(f"Episodes to 80 %: {'not reached' if np.isinf(reached) else int(reached)}.")
    if summary.get("nodes") is not None:
        facts.append(f"GWR-B nodes: {summary['nodes']}.")
    if summary.get("groups"):
        purity = " ".join(f"{100 * share:.1f}" for share in summary.get("group_purity") or ())
        facts.append(f"Groups: {summary['groups']}, {purity} % pure on held-out demonstrations.")
    if summary:
        facts.append(f"Commit {summary['commit']}: `{summary['command']}`.")
    if (run / "cost.csv").exists():
        facts += _cost(read_costs(run / "cost.csv"))
    lines += ["", " ".join(facts)]
    if own is not None and len(tasks) > 1:
        ratios = ", ".join(
            f"{task} {times or 'unknown'}"
            for task, times in zip(tasks[1:], ratio_cells(own), strict=True)
        )
        lines.append(f"Own episodes to 50 %, relative to {tasks[0]}: {ratios}.")
    return "\n".join(lines)


def _cost(costs: dict[int, Cost]) -> list[str]:
    """Return a sentence on the time of a training step and the memory; none without steps."""
    timed = [(tasks, cost) for tasks, cost in costs.items() if cost.steps]
    ends = timed if len(timed) < 2 else (timed[0], timed[-1])
    steps = " and ".join(
        f"{1000 * cost.seconds / cost.steps:.1f} ms with {tasks}" for tasks, cost in ends
    )
    memory = f"{timed[-1][1].megabytes:.0f} MB" if timed else ""
    return [f"A training step takes {steps} tasks presented, {memory}."] if timed else []


def _measured(run: Path) -> tuple[list[dict[str, str]] | None, dict[str, Any]]:
    """Return the final tests and the summary of a run; None and empty if only `Trainer` wrote it.

    Raises:
        ValueError: If a file is missing or damaged, or the run has not finished.
    """
    measured = any((run / name).exists() for name in ("final.csv", "summary.json"))
    needed = {} if measured else {"episodes": int, "eval_every": int}
    config = read_json(run / "config.json", needed)
    if not measured:
        tested = max(int(row["episode"]) for row in read_tests(run / "eval.csv"))
        if tested + config["eval_every"] <= config["episodes"]:
            raise ValueError(
                f"{run} has tests until episode {tested} of {config['episodes']}: let the run "
                "finish"
            )
        return None, {}
    final = read_final_tests(run / "final.csv")
    entries = {"commit": str, "command": str} | dict.fromkeys(
        ("nodes", "groups", "group_purity"), list | NoneType
    )
    summary = read_json(run / "summary.json", entries)
    if summary.get("episodes", config.get("episodes")) != config.get("episodes"):
        raise ValueError(f"{run} is being extended: let the run finish")
    return final, summary


def _has_groups(run: Path) -> bool:
    """Return whether a run found groups of behaviors."""
    path = run / "summary.json"
    if path.exists():
        return bool(read_json(path).get("groups"))
    rows = read_rows(run / "train.csv", {"num_groups": count})
    return any(int(row["num_groups"]) > 1 for row in rows)


def _tasks(rows: list[dict[str, str]]) -> list[str]:
    """Return the tested tasks, in the order of their first test."""
    return list(dict.fromkeys(row["task"] for row in rows))


def _late(rows: list[dict[str, str]]) -> list[dict[str, str]]:
    """Return the tests of the last 10 % of training."""
    last = max(int(row["episode"]) for row in rows)
    return [row for row in rows if int(row["episode"]) > 0.9 * last]


def _late_by_seed(path: Path) -> dict[str | None, list[float]]:
    rows = read_tests(path)
    late = _late(rows)
    seeds = sorted({int(row["seed"]) for row in rows})
    found: dict[str | None, list[float]] = {}
    for task in _tasks(rows):
        found[task] = []
        for seed in seeds:
            tests = [
                float(r["success"]) for r in late if (int(r["seed"]), r["task"]) == (seed, task)
            ]
            if not tests:
                raise ValueError(f"{path} has no late test of seed {seed}: let the run finish")
            found[task].append(float(np.mean(tests)))
    found[None] = np.mean(list(found.values()), 0).tolist()
    return found


def _presented(run: Path) -> dict[str, int]:
    """Return the training episode from which each task of a run is presented."""
    path = run / "config.json"
    config = read_json(path, {"task_starts": list, "tasks": list | NoneType})
    # Runs of earlier versions saved no task names; theirs are the paper's.
    tasks, starts = config.get("tasks") or nico.PAPER_TASKS, config["task_starts"]
    known = all(isinstance(task, str) for task in tasks)
    if not known or len(tasks) != len(starts) or not all(type(start) is int for start in starts):
        raise ValueError(
            f"{path} does not say when each task starts: put it back as the run left it"
        )
    return dict(zip(tasks, starts, strict=True))


def main(arguments: Arguments) -> None:
    """Print the tables and draw the figures."""
    if not arguments.runs:
        raise ValueError("name the directory of a run")
    for run in arguments.runs:
        described, presented = describe(run), _presented(run)
        print(f"{run}\n\n{described}\n")
        save_figure(plot_success_curves(run / "eval.csv", presented=presented), run / "success.png")
        if _has_groups(run):
            draw_groups(run, presented, run / "groups.png")


if __name__ == "__main__":
    try:
        main(tyro.cli(Annotated[Arguments, tyro.conf.OmitArgPrefixes], description=__doc__))
    except (ValueError, OSError) as error:
        sys.exit(f"error: {error}")
