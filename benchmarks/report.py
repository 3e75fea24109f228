"""Report of the paper's figures and claims, or of the benchmark of eight tasks, from finished runs.

    python benchmarks/report.py

reads the runs in ``benchmarks/results/comparison`` (or another directory) and writes beside them
Figs. 6, 7, 8 and 9 (mean over seeds and one standard deviation), ``tables.md`` with confidence
intervals and the claims, and ``report.html`` with all of these, frames of test episodes and the
runs' settings. Of runs named ``eight-ALGORITHM``, ``eight-reversed-ALGORITHM`` and
``eight-concurrent-ALGORITHM`` (``python benchmarks/continual.py --tasks all``, the tasks in reverse
order, ``benchmarks/concurrent_tasks.py --tasks all``) it makes the benchmark's table, heat maps of
success after each phase, learning curves, and nodes, groups and cost by the number of tasks.
Runs of other algorithms, such as ``eight-mine`` or ``continual-mine``, get rows of their own.
Missing runs are listed; longer runs are cut to the length of the shortest in their table.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from bgpo_trl.analysis import eight_tasks
from bgpo_trl.analysis.claims import LEVEL, additions, claims
from bgpo_trl.analysis.comparison import (
    Group,
    Run,
    read_group,
    with_own,
)
from bgpo_trl.analysis.intervals import Statistics
from bgpo_trl.analysis.paper_runs import GROUPS, SETTINGS
from bgpo_trl.analysis.tables import Table, continual_table, groups_table, main_table, speed_table
from bgpo_trl.experiments.arguments import command_line
from bgpo_trl.figures.counts import plot_counts, read_counts
from bgpo_trl.figures.curves import plot_success_curves
from bgpo_trl.figures.nodes import plot_gwr_pca
from bgpo_trl.figures.page import Section, write_page
from bgpo_trl.figures.style import save_figure
from bgpo_trl.figures.success_matrix import plot_success_matrices
from bgpo_trl.runs.results import read_rows


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
                {run.name: run.directory / "eval.csv" for run in shown},
                presented=_presented(first),
                random_success=first.summary.get("random_success"),
                window=3 * first.eval_every,
                last=int(first.curves.episodes[-1]),
            ),
            path,
        )
        figures[picture.caption] = path
    return figures


def _presented(run: Run) -> dict[str, int]:
    return dict(zip(run.tasks, run.config["task_starts"], strict=True))


def draw_nodes(path: Path, to: Path, names: Sequence[str]) -> Table:
    """Draw Fig. 7 from a run's ``gwr.csv``, by task and, if it has groups, by group.

    Args:
        path: The ``gwr.csv``.
        to: Path of the figure.
        names: Names of the run's tasks.

    Returns:
        A table of the distances between the tasks' mean nodes.
    """
    rows = read_rows(path)
    tasks = np.array([int(row["task"]) for row in rows])
    groups = [int(row["group"]) for row in rows] if "group" in rows[0] else None
    weights = np.array([[float(v) for k, v in row.items() if k.startswith("w")] for row in rows])
    save_figure(plot_gwr_pca(weights, tasks, names, groups), to)
    numbers = [task for task in range(len(names)) if (tasks == task).any()]
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
        ValueError: If there are no runs, or runs of different tasks.
    """
    statistics = Statistics()
    paper, runs = paper_sections(directory, out, statistics)
    eight, more = eight_sections(directory, out, statistics)
    if not runs and not more:
        raise ValueError(
            f"{directory} holds none of the runs that the figures need: name their directories "
            "EXPERIMENT-ALGORITHM, such as continual-bgpo"
        )
    return paper + eight, runs | more


def eight_sections(
    directory: Path, out: Path, statistics: Statistics
) -> tuple[list[Section], dict[str, Run]]:
    """Return the sections of the benchmark of eight tasks and its runs; none without runs."""
    groups = with_own(directory, eight_tasks.GROUPS)
    read = {key: read_group(directory, group) for key, group in groups.items()}
    runs = {name: run for found, _ in read.values() for name, run in found.items()}
    references, sections = read[eight_tasks.CONCURRENT][0], list[Section]()
    for key, (found, notes) in read.items() if runs else ():
        title = groups[key].title
        if not found:
            sections.append(Section(title, notes=notes))
            continue
        if key in eight_tasks.SEQUENCES:
            table = eight_tasks.benchmark_table(found, references, statistics)
            figures, about = draw_sequence(found, out / key), list(eight_tasks.NOTES)
            sections.append(Section(f"{title}: the benchmark", table, figures, about))
        curves = draw(groups[key], found, out)
        sections.append(Section(f"{title}: success", main_table(found, statistics), curves, notes))
        table = eight_tasks.cost_table(found)
        if table:
            title = f"{title}: cost of a training step of all seeds, by presented tasks"
            sections.append(Section(title, table))
    table = groups_table(runs[name] for name in sorted(runs))
    if table:
        sections.append(Section("Eight tasks: groups and inferred tasks, by seed", table))
    return sections, runs


def draw_sequence(runs: dict[str, Run], path: Path) -> dict[str, Path]:
    """Draw heat maps of success after each phase, and numbers of nodes and groups.

    Args:
        runs: Runs of tasks one after the other, by directory name.
        path: Path of the figures, without their endings.

    Returns:
        Paths of the figures by caption.
    """
    first = next(iter(runs.values()))
    matrices = {run.name: eight_tasks.success_matrix(run).mean(0) for run in runs.values()}
    figures = {"success on each task after each phase": path.with_name(f"{path.name}-matrix.png")}
    save_figure(plot_success_matrices(matrices, first.tasks), *figures.values())
    last, counts = int(first.curves.episodes[-1]), {}
    for run in runs.values():
        train = run.directory / "train.csv"
        of_run = read_counts(train, last) if train.exists() else {}
        if of_run and of_run["num_nodes"].any():
            counts[run.name] = of_run
    if counts:
        caption = "nodes and groups: mean over seeds, and from the lowest to the highest seed"
        figures[caption] = path.with_name(f"{path.name}-counts.png")
        save_figure(plot_counts(counts, _presented(first)), figures[caption])
    return figures


def paper_sections(
    directory: Path, out: Path, statistics: Statistics
) -> tuple[list[Section], dict[str, Run]]:
    """Return the sections of the paper's experiments and their runs; none without runs.

    Raises:
        ValueError: If the runs are of different tasks.
    """
    sections: list[Section] = []
    known = with_own(directory, GROUPS)
    read = {key: read_group(directory, group) for key, group in known.items()}
    groups = {key: found for key, (found, _) in read.items()}
    runs = {name: run for group in groups.values() for name, run in group.items()}
    if not runs:
        return [], {}
    if len({run.tasks for run in runs.values()}) > 1:
        raise ValueError(
            f"{directory} holds runs of different tasks: name a directory for each choice of tasks"
        )
    for key, group in known.items():
        notes = read[key][1]
        section = Section(group.title, notes=notes)
        # An ablation with only runs of other groups would repeat their tables.
        if any(not key.startswith("ablation") or name.startswith(key) for name in groups[key]):
            table = main_table(groups[key], statistics)
            section = Section(group.title, table, draw(group, groups[key], out), notes)
        sections.append(section)
    if groups["continual"] and len(next(iter(runs.values())).tasks) > 1:
        table = continual_table(groups["continual"], groups["concurrent"], statistics)
        about = ["Means over seeds, in points, with 95 % intervals."]
        sections.append(Section("Forgetting and transfer, continual", table, notes=about))
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
    if nodes.exists() and nodes.parent.name in runs:
        table = draw_nodes(nodes, out / "fig7.png", runs[nodes.parent.name].tasks)
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
