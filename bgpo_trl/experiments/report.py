"""Report of finished runs: tables and figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from bgpo_trl.analysis.comparison import Setting, read_settings, reference_of
from bgpo_trl.analysis.scores import success_matrix, success_steps
from bgpo_trl.analysis.tables import (
    Figures,
    Section,
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
from bgpo_trl.figures.style import COLORS, save_figure
from bgpo_trl.figures.success import (
    plot_step_curves,
    plot_success_curves,
    plot_success_matrices,
)
from bgpo_trl.files.writing import make_folder, without_folders, write_whole
from bgpo_trl.runs.results import archive_run, run_directories

# For a screen: figures of results are kept under version control.
_DPI = 150
# Curves that can be distinguished in one figure.
_CURVES = len(COLORS)


def curves_of(setting: Setting) -> Figures:
    """Plot the learning curves of a setting, some runs to a figure."""
    figures: Figures = {}
    window = 3 * setting.first.eval_every
    for start in range(0, len(setting.runs), _CURVES):
        runs = dict(list(setting.runs.items())[start : start + _CURVES])
        part = f"-{1 + start // _CURVES}" if start else ""
        caption = f"mean and one standard deviation over seeds: {', '.join(runs)}"
        figures[caption] = f"{setting.slug}{part}.png", plot_success_curves(runs, window=window)
        solving = {n: run for n, run in runs.items() if np.isfinite(success_steps(run)).any()}
        if solving:
            caption = f"steps of a success, shown likewise: {', '.join(solving)}"
            name = f"{setting.slug}-steps{part}.png"
            figures[caption] = name, plot_step_curves(solving, window=window)
    return figures


def setting_sections(setting: Setting, reference: Setting | None) -> list[Section]:
    """Return the sections of a setting, with their figures."""
    success = replace(success_section(setting), figures=curves_of(setting))
    sections = [success, *difference_section(setting)]
    if setting.in_sequence:
        try:
            found = sequence_section(setting, reference)
            matrices = {name: success_matrix(run).mean(0) for name, run in setting.runs.items()}
            figure = plot_success_matrices(matrices, setting.first.tasks)
            drawn = {
                "success on each task after each phase": (f"{setting.slug}-matrix.png", figure)
            }
            sections.append(replace(found, figures=drawn))
        except ValueError as error:  # tested too rarely
            title = f"Forgetting and transfer: {setting.title}"
            sections.append(Section(title, notes=[str(error)]))
    for share in (0.5, 0.8):
        sections += speed_section(setting, share)
    sections += [*groups_section(setting), *cost_section(setting)]
    return sections + [run_section(f"{n}: {setting.title}", r) for n, r in setting.runs.items()]


def write_sections(sections: Sequence[Section], out: Path) -> str:
    """Write ``tables.md`` and the figures of sections into a folder; return the tables.

    Notes name folders of this machine by their last name only, since reports are shared.
    """
    make_folder(out)
    text = []
    for section in sections:
        text.append(f"## {section.title}")
        text += [markdown(section.table)] if section.table else []
        for caption, (name, figure) in section.figures.items():
            save_figure(figure, out / name, _DPI)
            text.append(f"![{caption}]({name})")
        text += ["\n".join(f"- {without_folders(note)}" for note in section.notes if note)]
    joined = "\n\n".join(filter(None, text)) + "\n"
    write_whole(out / "tables.md", joined)
    return joined


def report(arguments: ReportArguments) -> str:
    """Write the report that `ReportArguments` describes; return its tables."""
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
        found, _ = read_settings(directories)  # Refuses before copying.
        runs = [run for setting in found for run in setting.runs.values()]
        finished = {directory for run in runs for directory in run.directories}
        pairs = zip(directories, copies, strict=True)
        targets = {directory: copy for directory, copy in pairs if directory in finished}
        for directory, copy in targets.items():
            archive_run(directory, copy)
        directories = [*targets.values()]
    settings, left_out = read_settings(directories)
    sections = [Section("Left out", notes=[left_out])] if left_out else []
    for setting in settings:
        sections += setting_sections(setting, reference_of(setting, settings))
    return write_sections(sections, arguments.out or arguments.archive or named[0])


def _names_in(folder: Path) -> list[Path]:
    """Return the paths of the runs in a folder, relative to it; of a run, its name."""
    runs = run_directories([folder])
    if runs == [folder]:
        return [Path(folder.resolve().name)]
    return [run.relative_to(folder) for run in runs]
