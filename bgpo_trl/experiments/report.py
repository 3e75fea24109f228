"""Report of finished runs: tables and figures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from bgpo_trl.analysis.comparison import Setting, read_settings, reference_of
from bgpo_trl.analysis.scores import success_matrix, success_steps
from bgpo_trl.analysis.tables import (
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


def draw_curves(setting: Setting, out: Path) -> dict[str, Path]:
    """Draw the learning curves of a setting, some runs to a figure; paths by caption."""
    figures: dict[str, Path] = {}
    for start in range(0, len(setting.runs), _CURVES):
        runs = dict(list(setting.runs.items())[start : start + _CURVES])
        part = f"-{1 + start // _CURVES}" if start else ""
        window = 3 * setting.first.eval_every
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
    sections += [*groups_section(setting), *cost_section(setting)]
    return sections + [run_section(f"{n}: {setting.title}", r) for n, r in setting.runs.items()]


def _drawn(sections: list[Section], draw: Callable[[], dict[str, Path]]) -> list[Section]:
    """Return sections with the figures that are drawn for them."""
    return [replace(section, figures=draw()) for section in sections]


def make_report(directories: Sequence[Path], out: Path) -> list[Section]:
    """Compute the tables and draw the figures of runs."""
    settings, left_out = read_settings(directories)
    references = [reference_of(setting, settings) for setting in settings]
    # All that may be refused comes before the first file.
    for setting in settings:
        for run in setting.runs.values():
            run_section("", run)
    make_folder(out)
    sections = [Section("Left out", notes=[left_out])] if left_out else []
    for setting, reference in zip(settings, references, strict=True):
        sections += setting_sections(setting, reference, out)
    return sections


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
        read_settings(directories)  # Refuses before copying.
        for directory, copy in zip(directories, copies, strict=True):
            archive_run(directory, copy)
        directories = copies
    out = arguments.out or arguments.archive or named[0]
    text = text_of(make_report(directories, out), out)
    write_whole(out / "tables.md", text)
    return text


def _names_in(folder: Path) -> list[Path]:
    """Return the paths of the runs in a folder, relative to it; of a run, its name."""
    runs = run_directories([folder])
    return [Path(folder.name)] if runs == [folder] else [run.relative_to(folder) for run in runs]
