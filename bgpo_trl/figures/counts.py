"""Figure of the numbers of nodes and groups over training, for several runs."""

from __future__ import annotations

import os
from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from bgpo_trl.figures.style import COLORS, LINES, add_legend, mark_starts, style_axes
from bgpo_trl.runs.results import COUNT, read_table

_PANELS = {"num_nodes": "Nodes of GWR-B", "num_groups": "Groups of behaviors"}


def read_counts(
    path: str | os.PathLike[str], last: int | None = None
) -> dict[str, NDArray[np.int64]]:
    """Read the numbers of nodes and groups after each training episode from a ``train.csv``.

    Args:
        path: The ``train.csv``.
        last: Last training episode to include; ``None`` for all.

    Returns:
        ``num_nodes`` and ``num_groups``, ``[S, E]``, up to the last episode of the slowest seed.

    Raises:
        ValueError: If the file is missing or damaged.
    """
    table = read_table(path, dict.fromkeys(("seed", "episode", *_PANELS), COUNT))
    if last is not None:
        table = table[table["episode"] <= last]
    counts = {}
    for name in _PANELS:
        of_seeds = table.pivot(index="seed", columns="episode", values=name).dropna(axis="columns")
        counts[name] = of_seeds.to_numpy(np.int64)
    return counts


def plot_counts(
    runs: Mapping[str, Mapping[str, NDArray[np.int64]]], presented: Mapping[str, int]
) -> Figure:
    """Plot the numbers of nodes and groups against training episodes.

    Lines are means over seeds, shaded from the lowest to the highest seed.

    Args:
        runs: By legend name, the result of `read_counts`.
        presented: Training episode from which each task is presented, by task name, in order;
            marked with dashed lines.

    Raises:
        ValueError: If there are no training episodes.
    """
    last = max((of_run["num_nodes"].shape[1] for of_run in runs.values()), default=0)
    if not last:
        raise ValueError("there is no training episode to show: let the run train first.")
    width = 7.0
    figure = Figure(figsize=(width, 4.6), layout="constrained")
    panels = figure.subplots(len(_PANELS), sharex=True)
    for panel, (column, title) in zip(panels, _PANELS.items(), strict=True):
        style_axes(panel)
        for index, (name, of_run) in enumerate(runs.items()):
            _draw_count(panel, of_run[column], name, index)
        mark_starts(panel, presented, list(presented), last)
        highest = max(int(of_run[column].max()) for of_run in runs.values())
        panel.set(xlim=(0, last), ylim=(0, 1.2 * highest))  # room for the labels of dashed lines
        panel.yaxis.set_major_locator(MaxNLocator(5, integer=True))
        panel.set_ylabel(title, fontsize=9)
    panels[-1].set_xlabel("Training episode", fontsize=9)
    panels[-1].xaxis.set_major_formatter("{x:,.0f}")
    handles, labels = panels[0].get_legend_handles_labels()
    add_legend(figure, handles, labels, width)
    return figure


def _draw_count(panel: Axes, counts: NDArray[np.int64], name: str, index: int) -> None:
    """Draw the counts of a run, ``[S, E]``."""
    episodes = np.arange(1, counts.shape[1] + 1)
    color, line = COLORS[index % len(COLORS)], LINES[index % len(LINES)]
    panel.plot(episodes, counts.mean(0), color=color, linestyle=line, linewidth=1.6, label=name)
    panel.fill_between(episodes, counts.min(0), counts.max(0), color=color, alpha=0.18, linewidth=0)
