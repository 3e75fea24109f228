"""Report of the paper's figures and claims from finished runs.

    python benchmarks/report.py

reads the runs in ``benchmarks/results/comparison`` (or another directory) and writes beside them
Figs. 6, 7, 8 and 9 (mean over seeds and one standard deviation), ``tables.md`` with confidence
intervals and the claims, and ``report.html`` with all of these, frames of test episodes and the
runs' settings. Missing runs are listed; longer runs are cut to the length of the shortest in their
table.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from bgpo_trl.analysis.claims import LEVEL, additions, claims
from bgpo_trl.analysis.comparison import GROUPS, SETTINGS, Group, Run, Statistics, read_group
from bgpo_trl.analysis.tables import Table, continual_table, groups_table, main_table, speed_table
from bgpo_trl.experiments.arguments import command_line
from bgpo_trl.figures.curves import plot_success_curves
from bgpo_trl.figures.nodes import plot_gwr_pca
from bgpo_trl.figures.page import Section, write_page
from bgpo_trl.figures.style import save_figure
from bgpo_trl.runs.results import read_rows
from suites import nico


@dataclass(frozen=True)
class Arguments:
    """Report on the runs in a directory."""

    runs: tyro.conf.Positional[Path] = Path("benchmarks/results/comparison")
    """Parent of the run directories, which are named EXPERIMENT-ALGORITHM."""
    out: Path | None = None
    """Folder of the report; by default that of the runs."""


def draw(group: Group, runs: dict[str, Run], folder: Path) -> dict[str, Path]:
    """Draw a group's learning curves.

    Returns:
        Paths of the figures by caption, without figures that lack all runs.
    """
    figures = {}
    for picture in group.pictures:
        shown = [runs[key] for key in picture.runs if key in runs]
        if not shown:
            continue
        first, path = shown[0], folder / f"{picture.file}.png"
        save_figure(
            plot_success_curves(
                [run.directory / "eval.csv" for run in shown],
                presented=dict(zip(nico.PAPER_TASKS, first.config["task_starts"], strict=True)),
                random_success=first.summary.get("random_success"),
                window=3 * first.config["eval_every"],
                last=int(first.curves.episodes[-1]),
                names={run.config["name"]: run.name for run in shown},
            ),
            path,
        )
        figures[picture.caption] = path
    return figures


def draw_nodes(path: Path, to: Path) -> Table:
    """Draw Fig. 7 from a run's ``gwr.csv``, by task and, if it has groups, by group.

    Returns:
        A table of the distances between the tasks' mean nodes.
    """
    rows = read_rows(path)
    tasks = np.array([int(row["task"]) for row in rows])
    groups = [int(row["group"]) for row in rows] if "group" in rows[0] else None
    weights = np.array([[float(v) for k, v in row.items() if k.startswith("w")] for row in rows])
    save_figure(plot_gwr_pca(weights, tasks, nico.PAPER_TASKS, groups), to)
    numbers = [task for task in range(len(nico.PAPER_TASKS)) if (tasks == task).any()]
    means = {task: weights[tasks == task].mean(0) for task in numbers}
    table: Table = [["distance of mean nodes", *(f"task {task + 1}" for task in numbers)]]
    for task in numbers:
        apart = [float(np.linalg.norm(means[task] - means[other])) for other in numbers]
        table.append([f"task {task + 1}", *(f"{distance:.2f}" for distance in apart)])
    return table


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """Format a table in Markdown."""
    head, *body = rows
    lines = [head, ["---"] * len(head), *body]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def read_sections(directory: Path, out: Path) -> tuple[list[Section], dict[str, Run]]:
    """Read the runs in a directory, draw the figures and compute the tables.

    Args:
        directory: Parent of the run directories.
        out: Folder of the figures.

    Returns:
        The sections of the report, and the runs by directory name.

    Raises:
        ValueError: If there are no runs.
    """
    statistics = Statistics()
    groups: dict[str, dict[str, Run]] = {}
    sections: list[Section] = []
    for key, group in GROUPS.items():
        groups[key], notes = read_group(directory, group)
        section = Section(group.title, notes=notes)
        # An ablation with only runs of other groups would repeat their tables.
        if any(not key.startswith("ablation") or name.startswith(key) for name in groups[key]):
            table = main_table(groups[key], statistics)
            section = Section(group.title, table, draw(group, groups[key], out), notes)
        sections.append(section)
    runs = {name: run for group in groups.values() for name, run in group.items()}
    if not runs:
        raise ValueError(f"{directory} holds none of the runs that the figures need")
    if groups["continual"]:
        table = continual_table(groups["continual"], groups["concurrent"])
        sections.append(Section("Forgetting and transfer, continual (points)", table))
    for setting, (_, about) in SETTINGS.items():
        of_setting = groups[setting] | groups[f"{setting}-paper"]
        if of_setting:
            title = f"Training episodes of a task until half of its last 20 succeed, {about}"
            sections.append(Section(title, speed_table(of_setting)))
    table = groups_table(runs[name] for name in sorted(runs))
    if table:
        title = "Groups found and tasks inferred on held-out demonstrations, by seed"
        sections.append(Section(title, table))
    title, nodes = "Fig. 7: nodes of one GWR-B", directory / "concurrent-bgpo" / "gwr.csv"
    if nodes.exists():
        table = draw_nodes(nodes, out / "fig7.png")
        figures = {"first two principal components, first seed": out / "fig7.png"}
        sections.append(Section(title, table, figures))
    else:
        missing = f"missing ({nodes.relative_to(directory)} is not there)"
        sections.append(Section(title, notes=[missing]))
    sections.append(Section("The paper's claims", claims(groups, statistics), notes=[LEVEL]))
    table = additions(groups, statistics)
    if table:
        sections.append(Section("Additions to the paper's algorithm", table, notes=[LEVEL]))
    return sections, runs


def main(arguments: Arguments) -> None:
    """Write the report."""
    if not arguments.runs.is_dir():
        raise ValueError(f"{arguments.runs} is not a directory: name the one that holds the runs")
    out = arguments.out or arguments.runs
    sections, runs = read_sections(arguments.runs, out)
    text = []
    for section in sections:
        text += [f"## {section.title}", *([markdown(section.table)] if section.table else [])]
        text += ["\n".join(f"- {note}" for note in section.notes)] if section.notes else []
    (out / "tables.md").write_text("\n\n".join(text) + "\n")
    write_page(
        out / "report.html",
        sections,
        {key: (run.directory, run.config, run.summary) for key, run in runs.items()},
    )
    print("\n\n".join(text))


if __name__ == "__main__":
    command_line(main, __doc__, Arguments)
