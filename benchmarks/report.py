"""The paper's figures and claims, from the directories of runs.

    python benchmarks/report.py

reads the runs in ``benchmarks/results/comparison`` (or another directory of them) and writes beside
them Figs. 6, 7, 8 and 9 (mean over seeds and one standard deviation), ``tables.md`` with confidence
intervals and the claims, and ``report.html``, which holds all of it with frames of test episodes
and the runs' settings. A run that is not there is listed as missing; one that is longer than
another of its figure is cut to the length of the shortest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from comparison import (
    GROUPS,
    Group,
    Run,
    Statistics,
    Table,
    claims,
    continual_table,
    main_table,
    read_group,
)
from experiment import command_line
from report_page import Section, write_page

from bgpo_trl.plotting import plot_gwr_pca, plot_success_curves, save_figure
from bgpo_trl.runs import read_rows
from suites import nico


@dataclass(frozen=True)
class Arguments:
    """Reports on the runs in a directory."""

    runs: tyro.conf.Positional[Path] = Path("benchmarks/results/comparison")
    """Holds one directory a run, named EXPERIMENT-ALGORITHM."""
    out: Path | None = None
    """Where the report goes; beside the runs if not given."""


def draw(group: Group, runs: dict[str, Run], path: Path) -> None:
    """Draws a group's learning curves."""
    first = next(iter(runs.values()))
    save_figure(
        plot_success_curves(
            [run.directory / "eval.csv" for run in runs.values()],
            presented=dict(zip(nico.ALL_TASKS, first.config["task_starts"], strict=True)),
            random_success=first.summary.get("random_success"),
            window=3 * first.config["eval_every"],
            last=int(first.curves.episodes[-1]),
            names={run.config["name"]: run.name for run in runs.values()},
        ),
        path,
    )


def draw_nodes(path: Path, to: Path) -> Table:
    """Draws Fig. 7 from a run's ``gwr.csv``.

    Returns:
        A table of the distances between the mean nodes of the tasks.
    """
    rows = read_rows(path)
    tasks = np.array([int(row["task"]) for row in rows])
    weights = np.array([[float(v) for k, v in row.items() if k != "task"] for row in rows])
    save_figure(plot_gwr_pca(weights, tasks, nico.ALL_TASKS), to)
    numbers = range(len(nico.ALL_TASKS))
    means = [weights[tasks == task].mean(0) for task in numbers]
    table: Table = [["distance of mean nodes", *(f"task {task + 1}" for task in numbers)]]
    for task in numbers:
        apart = [float(np.linalg.norm(means[task] - means[other])) for other in numbers]
        table.append([f"task {task + 1}", *(f"{distance:.2f}" for distance in apart)])
    return table


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """Returns a table in Markdown."""
    head, *body = rows
    lines = [head, ["---"] * len(head), *body]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def main(arguments: Arguments) -> None:
    """Writes the report."""
    if not arguments.runs.is_dir():
        raise ValueError(f"{arguments.runs} is no directory: name the one that holds the runs")
    out = arguments.out or arguments.runs
    statistics = Statistics()
    groups: dict[str, dict[str, Run]] = {}
    sections: list[Section] = []
    for key, group in GROUPS.items():
        groups[key], notes = read_group(arguments.runs, group)
        figure = None
        table: Table = []
        if groups[key]:
            figure = out / f"fig{group.figure}.png"
            draw(group, groups[key], figure)
            table = main_table(groups[key], statistics)
        sections.append((f"Fig. {group.figure}: {group.title}", figure, table, notes))
    if not any(groups.values()):
        raise ValueError(f"{arguments.runs} holds none of the runs that the figures need")
    if groups["continual"]:
        table = continual_table(groups["continual"], groups["concurrent"])
        sections.append(("Forgetting and transfer, continual (points)", None, table, []))
    nodes = arguments.runs / "concurrent-bgpo" / "gwr.csv"
    if nodes.exists():
        table = draw_nodes(nodes, out / "fig7.png")
        sections.append(("Fig. 7: nodes of one GWR-B", out / "fig7.png", table, []))
    else:
        missing = [f"missing ({nodes.relative_to(arguments.runs)} is not there)"]
        sections.append(("Fig. 7: nodes of one GWR-B", None, [], missing))
    sections.append(("The paper's claims", None, claims(groups, statistics), []))

    text = []
    for title, _, table, notes in sections:
        text += [f"## {title}", *([markdown(table)] if table else [])]
        text += ["\n".join(f"- {note}" for note in notes)] if notes else []
    (out / "tables.md").write_text("\n\n".join(text) + "\n")
    runs = {key: run for group in groups.values() for key, run in group.items()}
    write_page(
        out / "report.html",
        sections,
        {key: (run.directory, run.config, run.summary) for key, run in runs.items()},
    )
    print("\n\n".join(text))


if __name__ == "__main__":
    command_line(main, __doc__, Arguments)
