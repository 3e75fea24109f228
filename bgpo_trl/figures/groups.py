"""Figures of the groups of behaviors: numbers of nodes and groups, and the episodes of each group.

The data are training episodes from ``train.csv``.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from bgpo_trl.figures.style import (
    COLORS,
    LINES,
    add_legend,
    mark_starts,
    save_figure,
    style_axes,
    task_markers,
)
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


def read_groups(path: str | os.PathLike[str], task_names: Sequence[str]) -> pd.DataFrame:
    """Read the groups of a run from its ``train.csv``.

    Args:
        path: The ``train.csv``.
        task_names: Names of the tasks.

    Returns:
        A row for each training episode, ordered by ``seed`` and ``episode``, with the position of
        its ``task`` in the names, the ``group`` that acted, and ``num_groups`` after the episode;
        groups may have merged before.

    Raises:
        ValueError: If the file is missing or damaged, or its run has no groups.
    """
    numbers = dict.fromkeys(("seed", "episode", "group", "num_groups"), COUNT)
    table = read_table(path, {"task": task_names, **numbers}).sort_values(["seed", "episode"])
    return table.assign(task=table["task"].map(list(task_names).index))


def plot_groups(episodes: pd.DataFrame, presented: Mapping[str, int]) -> Figure:
    """Plot the number of groups over training and, for each seed, the episodes of each group.

    Each group that has acted has a row, shaded from its first to its last episode, with a mark for
    each of its episodes in the color of the task. Marks of rarer tasks are drawn on top; the panel
    titles give the purity.

    Args:
        episodes: Training episodes from `read_groups`.
        presented: Training episode from which each task is presented, by task name.

    Raises:
        ValueError: If there are no episodes.
    """
    if episodes.empty:
        raise ValueError("there is no training episode to show: let the run train first.")
    tasks, last = list(presented), int(episodes["episode"].max())
    seeds = dict(iter(episodes.groupby("seed")))
    heights = [of_seed["group"].nunique() for of_seed in seeds.values()]
    # Inches; rows get thinner so that all of them fit on a page.
    row = min(0.17, 7.0 / sum(heights))
    width = 7.0
    sizes = [1.0, *(row * height for height in heights)]
    figure = Figure(figsize=(width, sum(sizes) + 0.36 * len(sizes) + 0.7), layout="constrained")
    panels = figure.subplots(len(sizes), sharex=True, height_ratios=sizes)
    for axes in panels:
        style_axes(axes)
        axes.grid(visible=False)

    mark_starts(panels[0], presented, tasks, last)
    _draw_numbers(panels[0], list(seeds.values()))
    for axes, (seed, of_seed) in zip(panels[1:], seeds.items(), strict=True):
        _draw_rows(axes, of_seed, len(tasks), last, width)
        number, purity = of_seed["num_groups"].iloc[-1], _purity(of_seed)
        title = f"seed {seed}: {number} groups, {100 * purity:.1f} % pure"
        axes.set_title(title, fontsize=8, loc="left", pad=3)
    panels[-1].set_xlabel("Training episode", fontsize=9)
    panels[-1].set_xlim(0, last)
    panels[-1].xaxis.set_major_formatter("{x:,.0f}")
    kinds = task_markers(tasks)
    handles = [Line2D([], [], color=c, marker="s", linestyle="", ms=6) for _, _, c, _ in kinds]
    add_legend(figure, handles, [name for _, name, _, _ in kinds], width)
    return figure


def _purity(episodes: pd.DataFrame) -> float:
    """Return the share of the episodes whose task is the most frequent one of their group."""
    counts = episodes.groupby(["group", "task"]).size()
    return counts.groupby("group").max().sum() / len(episodes)


def _draw_numbers(axes: Axes, seeds: Sequence[pd.DataFrame]) -> None:
    """Draw the number of groups of each seed, the first seed on top."""
    for number, run in reversed(list(enumerate(seeds))):
        color, line = ("0.2", 1.4) if number == 0 else ("0.7", 0.9)
        axes.step(run["episode"], run["num_groups"], where="post", color=color, linewidth=line)
    highest = max(int(run["num_groups"].max()) for run in seeds)
    axes.set(ylim=(0, 1.3 * highest))  # room for the labels of the dashed lines
    axes.yaxis.set_major_locator(MaxNLocator(4, integer=True))
    axes.set_ylabel("Groups" if len(seeds) == 1 else "Groups\n(gray: others)", fontsize=8)


def _draw_rows(axes: Axes, seed: pd.DataFrame, n_tasks: int, last: int, width: float) -> None:
    """Draw the episodes of each group of a seed, in a row for each group."""
    colors = [color for _, _, color, _ in task_markers([""] * n_tasks)]
    # Points; the width of one episode on the axis, at least 0.4 to stay visible.
    line = max(0.4, 0.85 * 72 * width / last)
    numbers = []
    for row, (number, group) in enumerate(seed.groupby("group")):
        numbers.append(number)
        first, end = group["episode"].iloc[0], group["episode"].iloc[-1]
        axes.barh(row, end - first, 0.8, first, color="0.94", zorder=0)
        episodes = [group.loc[group["task"] == task, "episode"] for task in range(n_tasks)]
        for task in sorted(range(n_tasks), key=lambda task: -len(episodes[task])):
            marks = axes.vlines(episodes[task], row - 0.4, row + 0.4, colors[task], lw=line)
            marks.set_snap(False)  # Snapping to pixels would leave gaps between neighbors.
    axes.set(ylim=(len(numbers) - 0.4, -0.6))
    each = math.ceil(len(numbers) / 10)
    axes.set_yticks(range(0, len(numbers), each), [str(number) for number in numbers[::each]])
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)
    axes.set_ylabel("Group", fontsize=8)


def draw_groups(run: Path, presented: Mapping[str, int], out: Path) -> None:
    """Write the figure of the groups of a run to the path ``out``; arguments as for `plot_groups`.

    Raises:
        ValueError: If ``train.csv`` is missing or damaged, or the run has no groups.
    """
    save_figure(plot_groups(read_groups(run / "train.csv", list(presented)), presented), out)
