"""Report of finished runs: tables and figures, or the difference between two runs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from bgpo_trl.analysis import statistics
from bgpo_trl.analysis.comparison import (
    Setting,
    differing_conditions,
    read_settings,
    reference_of,
    under_equal_conditions,
)
from bgpo_trl.analysis.scores import (
    Values,
    evaluation_matrix,
    late_scores,
    success_matrix,
    success_steps,
)
from bgpo_trl.analysis.tables import (
    Section,
    Table,
    claims_section,
    cost_section,
    difference_section,
    groups_section,
    markdown,
    run_section,
    sequence_section,
    speed_section,
    success_section,
)
from bgpo_trl.experiments.arguments import ReportArguments
from bgpo_trl.figures.groups import plot_counts, plot_groups
from bgpo_trl.figures.gwr import plot_gwr_pca
from bgpo_trl.figures.style import COLORS, save_figure
from bgpo_trl.figures.success import (
    plot_step_curves,
    plot_success_curves,
    plot_success_matrices,
)
from bgpo_trl.files.writing import make_folder, without_folders, write_whole
from bgpo_trl.runs.results import (
    Run,
    archive_run,
    find_table,
    joined,
    read_run,
    read_table,
    run_directories,
)

# For a screen: figures of results are kept under version control.
_DPI = 150
# Curves that can be distinguished in one figure.
_CURVES = len(COLORS)


def draw_curves(setting: Setting, out: Path) -> dict[str, Path]:
    """Draw the learning curves of a setting, some runs to a figure; paths by caption."""
    figures: dict[str, Path] = {}
    for start in range(0, len(setting.runs), _CURVES):
        runs = dict(list(setting.runs.items())[start : start + _CURVES])
        part = f"-{1 + start // _CURVES}" if start else ""
        window = 3 * next(iter(runs.values())).eval_every
        path = out / f"{setting.slug}{part}.png"
        save_figure(plot_success_curves(runs, window=window), path, _DPI)
        figures[f"mean and one standard deviation over seeds: {', '.join(runs)}"] = path
        solving = {n: run for n, run in runs.items() if np.isfinite(success_steps(run)).any()}
        if solving:
            path = out / f"{setting.slug}-steps{part}.png"
            save_figure(plot_step_curves(solving, window=window), path, _DPI)
            figures[f"steps of a success, shown likewise: {', '.join(solving)}"] = path
    return figures


def draw_sequence(setting: Setting, out: Path) -> dict[str, Path]:
    """Draw success after each phase as heat maps; paths by caption."""
    path = out / f"{setting.slug}-matrix.png"
    matrices = {name: success_matrix(run).mean(0) for name, run in setting.runs.items()}
    save_figure(plot_success_matrices(matrices, setting.first.tasks), path, _DPI)
    return {"success on each task after each phase": path}


def draw_counts(setting: Setting, out: Path) -> dict[str, Path]:
    """Draw the numbers of nodes and groups over training; paths by caption, none without GWR-B."""
    runs = {
        name: run
        for name, run in setting.runs.items()
        if run.training is not None and run.summary.get("nodes") is not None
    }
    if not runs:
        return {}
    path = out / f"{setting.slug}-counts.png"
    save_figure(plot_counts(runs), path, _DPI)
    return {"nodes and groups: mean over seeds, from the lowest to the highest seed": path}


def draw_nodes(run: Run, path: Path) -> Table:
    """Draw the nodes of a run's GWR-B (Fig. 7); return the distances of the tasks' mean nodes."""
    table = read_table(run.directory / "gwr.csv")
    tasks = table["task"].to_numpy(np.int64)
    groups = table["group"].to_numpy(np.int64) if "group" in table else None
    weights = table.filter(regex=r"^w\d+$").to_numpy(float)
    save_figure(plot_gwr_pca(weights, tasks, run.tasks, groups), path, _DPI)
    numbers = [task for task in range(len(run.tasks)) if (tasks == task).any()]
    means = {task: weights[tasks == task].mean(0) for task in numbers}
    rows: Table = [["distance of mean nodes", *(f"task {task + 1}" for task in numbers)]]
    for task in numbers:
        apart = [float(np.linalg.norm(means[task] - means[other])) for other in numbers]
        rows.append([f"task {task + 1}", *(f"{distance:.2f}" for distance in apart)])
    return rows


def setting_sections(setting: Setting, reference: Setting | None, out: Path) -> list[Section]:
    """Return the sections of a setting and draw its figures."""
    sections = _drawn(success_section(setting), lambda: draw_curves(setting, out))
    sections += difference_section(setting)
    if setting.in_sequence:
        try:
            found = sequence_section(setting, reference)
            sections += _drawn(found, lambda: draw_sequence(setting, out))
        except ValueError as error:  # tested too rarely
            title = f"Forgetting and transfer: {setting.title}"
            sections.append(Section(title, notes=[str(error)]))
    for share in (0.5, 0.8):
        sections += speed_section(setting, share)
    sections += _drawn(groups_section(setting), lambda: draw_counts(setting, out))
    with_nodes = [n for n, run in setting.runs.items() if find_table(run.directory / "gwr.csv")]
    for name in with_nodes[:1]:
        path = out / f"{setting.slug}-nodes.png"
        table = draw_nodes(setting.runs[name], path)
        figures = {f"{name}, first seed: first two principal components": path}
        sections.append(Section(f"Nodes of GWR-B: {setting.title}", table, figures))
    sections += cost_section(setting)
    sections += [run_section(f"{n}: {setting.title}", run) for n, run in setting.runs.items()]
    return sections


def _drawn(sections: list[Section], draw: Callable[[], dict[str, Path]]) -> list[Section]:
    """Return sections with the figures that are drawn for them."""
    return [replace(section, figures=draw()) for section in sections]


def make_report(
    directories: Sequence[Path], out: Path, *, anyway: bool = False
) -> tuple[list[Section], dict[Path, Run]]:
    """Compute the tables and draw the figures of runs; return sections, and runs by directory.

    Raises:
        ValueError: If a run is damaged, none is finished, or conditions differ.
    """
    settings, left_out = read_settings(directories, anyway=anyway)
    references = [reference_of(setting, settings, anyway=anyway) for setting in settings]
    # All that may be refused comes before the first file.
    for setting in settings:
        for run in setting.runs.values():
            run_section("", run)
    make_folder(out)
    sections = [Section("Left out", notes=[left_out])] if left_out else []
    for setting, reference in zip(settings, references, strict=True):
        sections += setting_sections(setting, reference, out)
    pairs: list[tuple[Setting | None, Setting | None]] = [
        (s, r) for s, r in zip(settings, references, strict=True) if s.in_sequence
    ]
    paired = [reference for _, reference in pairs]
    pairs += [(None, s) for s in settings if s.from_start and s not in paired]
    for continual, concurrent in pairs:
        sections += claims_section(continual, concurrent)
    runs = [run for setting in settings for run in setting.runs.values()]
    return sections, {directory: run for run in runs for directory in run.directories}


def text_of(sections: Sequence[Section], out: Path) -> str:
    """Return sections in Markdown; figures are linked from the folder ``out``.

    Notes name folders of this machine by their last name only, since reports are shared.
    """
    text = []
    for section in sections:
        text.append(f"## {section.title}")
        text += [markdown(section.table)] if section.table else []
        text += [
            f"![{caption}]({path.relative_to(out).as_posix()})"
            for caption, path in section.figures.items()
        ]
        text += ["\n".join(f"- {without_folders(note)}" for note in section.notes if note)]
    return "\n\n".join(filter(None, text)) + "\n"


def report(arguments: ReportArguments) -> str:
    """Write the report that `ReportArguments` describes; return its tables.

    Raises:
        ValueError: If a run is damaged, none is finished, or conditions differ.
    """
    if arguments.compare:
        return compare(arguments.runs, every=arguments.every, anyway=arguments.anyway)
    named = list(arguments.runs)
    if not named:
        raise ValueError("name a run, or a folder of runs")
    if arguments.out is None and arguments.archive is None and len(named) > 1:
        raise ValueError("--out: several folders are given, name that of the report")
    directories = run_directories(named)
    if arguments.archive is not None:
        copies = [arguments.archive / name for folder in named for name in _names_in(folder)]
        if len({*copies}) < len(copies):
            raise ValueError("--archive: runs of the same name are given, use one folder for each")
        # Refuses before copying.
        read_settings(directories, anyway=arguments.anyway)
        for directory, copy in zip(directories, copies, strict=True):
            archive_run(directory, copy)
        directories = copies
    out = arguments.out or arguments.archive or named[0]
    sections, runs = make_report(directories, out, anyway=arguments.anyway)
    for directory in directories if directories == named else ():
        run = runs.get(directory)
        if run is not None and max(run.summary.get("groups") or [0]) > 1:
            save_figure(plot_groups(run), out / f"{directory.name}-groups.png")
    text = text_of(sections, out)
    write_whole(out / "tables.md", text)
    return text


def _names_in(folder: Path) -> list[Path]:
    """Return the paths of the runs in a folder, relative to it; of a run, its name."""
    runs = run_directories([folder])
    return [Path(folder.name)] if runs == [folder] else [run.relative_to(folder) for run in runs]


def compare(paths: Sequence[Path], *, every: int | None = None, anyway: bool = False) -> str:
    """Return the table of differences between two runs, of each task and their mean.

    It has the success of both over the last 10 % of training, the second's lead with its 95 %
    interval (Welch), the p value of a permutation test of seeds, and what is found. If one run is
    not finished yet, only the part that both have is compared.

    Args:
        paths: Directories of the two runs.
        every: Also compare over each part of training of so many episodes.
        anyway: Compare also runs under different conditions, of which a note is returned.

    Raises:
        ValueError: If there are not two runs of the same tasks, a run is damaged, or conditions
            differ.
    """
    if len(paths) != 2:
        raise ValueError(f"--compare: name two run directories, got {len(paths)}")
    if every is not None and every < 1:
        raise ValueError(f"--every must be at least 1 episode, got {every}")
    first, second = map(_one_run, paths)
    if first.tasks != second.tasks:
        differing = differing_conditions(first, second)
        raise ValueError(f"{differing}: only runs of the same tasks in the same order are compared")
    runs, notes = under_equal_conditions((first, second), anyway=anyway)
    last = runs[0].last
    rows: Table = [["episodes", "task", "first", "second", "second - first", "p", "found"]]
    part = last + 1 if every is None else every
    for end in range(part, last + 1, part):
        matrices = [evaluation_matrix(run, [end], window=part) for run in runs]
        rows += _differences(f"to {end}", first.tasks, *(matrix[:, 0] for matrix in matrices))
    rows += _differences("last 10 %", first.tasks, *map(late_scores, runs))
    return "\n\n".join([*notes, markdown(rows)])


def _one_run(path: Path) -> Run:
    """Return the run in a directory, or that of runs in it that differ in their seeds alone."""
    runs = joined(map(read_run, run_directories([path])))
    if len(runs) > 1:
        raise ValueError(f"--compare: {path} holds {len(runs)} runs, name one of them")
    return runs[0]


def _differences(period: str, tasks: tuple[str, ...], first: Values, second: Values) -> Table:
    """Return a row for each task and their mean, from scores ``[S, T]``.

    Tasks that were not tested are left out.
    """
    tested = [index for index in range(len(tasks)) if not np.isnan(first[:, index]).any()]
    tested = [index for index in tested if not np.isnan(second[:, index]).any()]
    rows = []
    for what, chosen in [*((tasks[index], [index]) for index in tested), ("all", tested)]:
        if not chosen:
            continue
        ours, theirs = first[:, chosen].mean(1), second[:, chosen].mean(1)
        found = statistics.difference(theirs, ours)
        p = "-" if np.isnan(found.p) else f"{found.p:.3f}"
        cells = [f"{100 * scores.mean():.1f}" for scores in (ours, theirs)]
        rows.append([period, what, *cells, found.estimate.points(), p, found.note])
    return rows
