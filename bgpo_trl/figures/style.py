"""Common style of the figures, and saving them.

Figures are drawn without pyplot, hence without global state. Colors are Okabe and Ito's
colorblind-safe palette; line styles and markers differ as well.
"""

from __future__ import annotations

import io
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bgpo_trl.files.writing import make_folder, write_whole

COLORS = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
    "#E69F00",
    "#56B4E9",
    "#000000",
    "#F0E442",
)
"""Colors of algorithms, or of tasks."""
LINES = ("-", "--", "-.", (0, (3, 1, 1, 1, 1, 1)), (0, (1, 1)), (0, (6, 2)))
"""Line styles that accompany them."""
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
"""Markers that accompany them."""
DPI = 300
"""Resolution of saved figures, for print."""


def save_figure(figure: Figure, path: str | os.PathLike[str], dpi: int = DPI) -> None:
    """Save a figure as PNG; the same figure always gives the same bytes."""
    path = Path(path)
    make_folder(path.parent)
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=dpi, metadata={"Software": None})
    write_whole(path, content.getvalue())


def style_axes(axes: Axes) -> None:
    """Give axes small ticks and a faint grid, without the upper and right spine."""
    axes.tick_params(labelsize=8, length=3)
    axes.grid(color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def add_legend(above: Figure | Axes, handles: list[Any], labels: list[str], width: float) -> None:
    """Add a legend above a figure or axes, in as many columns as fit into ``width`` (inches)."""
    # Inches: a letter of this size is about 0.065 wide, a handle with its gaps 0.55.
    sizes = [0.065 * len(label) + 0.55 for label in labels]
    columns = len(labels) if sum(sizes) <= width else max(1, int(width / max(sizes)))
    outside: dict[str, Any] = {"loc": "outside upper center"}
    if isinstance(above, Axes):
        outside = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0)}
    above.legend(handles, labels, ncols=columns, fontsize=8.5, frameon=False, **outside)


def mark_starts(axes: Axes, starts: Mapping[str, int], tasks: Sequence[str], last: int) -> None:
    """Mark the episodes from which tasks are presented with dashed lines, inside the axes.

    ``starts`` are the episodes by task name; a label gives the position of its task in ``tasks``,
    which stands alone where there are many.
    The axes end at episode ``last`` and have the height 1.1 in the scale of the labels.
    """
    prefix = "task " if len(starts) <= 6 else ""
    for task, episode in starts.items():
        if not 0 < episode < last:
            continue
        axes.axvline(episode, color="0.35", linestyle=(0, (4, 3)), linewidth=0.9)
        axes.annotate(
            f"{prefix}{tasks.index(task) + 1}",
            (episode, 1.05 / 1.1),
            xycoords=axes.get_xaxis_transform(),
            xytext=(3, 0),
            textcoords="offset points",
            va="center",
            fontsize=7.5,
            color="0.25",
        )


def markers(
    names: Mapping[int, str], colors: Sequence[str] = COLORS
) -> list[tuple[int, str, str, str]]:
    """Return number, legend name, color and marker of each of some things, by their numbers."""
    return [
        (number, name, colors[number % len(colors)], MARKERS[number % len(MARKERS)])
        for number, name in names.items()
    ]


def task_markers(tasks: Sequence[str]) -> list[tuple[int, str, str, str]]:
    """Return position, legend name, color and marker of each task."""
    return markers({n: f"task {n + 1}: {readable(task)}" for n, task in enumerate(tasks)})


def readable(name: str) -> str:
    """Return a task's name in words, for a label: Matplotlib sets what is between dollars."""
    return name.replace("_", " ").replace("$", r"\$")
