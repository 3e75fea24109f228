"""Figure of the groups of behaviors in a run: their number and their episodes."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from bgpo_trl.figures.style import add_legend, mark_starts, style_axes, task_markers
from bgpo_trl.runs.results import COUNT, Cells, read_table


@dataclass(frozen=True)
class GroupedEpisodes:
    """Training episodes of one seed, in order.

    Attributes:
        episode: Training episode, ``[E]``.
        task: Position of its task in the task names, ``[E]``.
        group: Group that acted, ``[E]``.
        num_groups: Number of groups after the episode, ``[E]``; groups may have merged before.
    """

    episode: NDArray[np.int64]
    task: NDArray[np.int64]
    group: NDArray[np.int64]
    num_groups: NDArray[np.int64]

    @property
    def numbers(self) -> list[int]:
        """Numbers of the groups that have acted, ascending."""
        return np.unique(self.group).tolist()

    @property
    def purity(self) -> float:
        """Share of the episodes whose task is the most frequent one of their group."""
        counts = np.zeros((self.group.max() + 1, self.task.max() + 1))
        np.add.at(counts, (self.group, self.task), 1)
        return float(counts.max(axis=1).sum() / len(self.task))


def read_groups(
    path: str | os.PathLike[str], task_names: Sequence[str]
) -> dict[int, GroupedEpisodes]:
    """Read the groups of a run from its ``train.csv``: training episodes by seed, in order.

    Raises:
        ValueError: If the file is missing or damaged, or its run has no groups.
    """
    columns: dict[str, Cells] = {"task": task_names}
    columns |= dict.fromkeys(("seed", "episode", "group", "num_groups"), COUNT)
    table = read_table(path, columns).sort_values(["seed", "episode"])
    table["task"] = table["task"].map(list(task_names).index)
    shown = ["episode", "task", "group", "num_groups"]
    return {
        int(seed): GroupedEpisodes(*table.loc[table["seed"] == seed, shown].to_numpy(np.int64).T)
        for seed in table["seed"].unique()
    }


def plot_groups(seeds: Mapping[int, GroupedEpisodes], presented: Mapping[str, int]) -> Figure:
    """Plot the number of groups over training and, for each seed, the episodes of each group.

    Each group that has acted has a row, shaded from its first to its last episode, with a mark for
    each of its episodes in the color of the task. Marks of rarer tasks are drawn on top; the panel
    titles give the purity.

    Args:
        seeds: Training episodes by seed, from `read_groups`.
        presented: Training episode from which each task is presented, by task name.

    Raises:
        ValueError: If there are no episodes.
    """
    if not seeds:
        raise ValueError("there is no training episode to show: let the run train first.")
    tasks = list(presented)
    last = max(int(run.episode[-1]) for run in seeds.values())
    heights = [len(run.numbers) for run in seeds.values()]
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
    _draw_counts(panels[0], list(seeds.values()))
    for axes, (seed, run) in zip(panels[1:], seeds.items(), strict=True):
        _draw_rows(axes, run, len(tasks), last, width)
        title = f"seed {seed}: {run.num_groups[-1]} groups, {100 * run.purity:.1f} % pure"
        axes.set_title(title, fontsize=8, loc="left", pad=3)
    panels[-1].set_xlabel("Training episode", fontsize=9)
    panels[-1].set_xlim(0, last)
    panels[-1].xaxis.set_major_formatter("{x:,.0f}")
    kinds = task_markers(tasks)
    handles = [Line2D([], [], color=c, marker="s", linestyle="", ms=6) for _, _, c, _ in kinds]
    add_legend(figure, handles, [name for _, name, _, _ in kinds], width)
    return figure


def _draw_counts(axes: Axes, runs: Sequence[GroupedEpisodes]) -> None:
    """Draw the number of groups of each seed, the first seed on top."""
    for number, run in reversed(list(enumerate(runs))):
        color, line = ("0.2", 1.4) if number == 0 else ("0.7", 0.9)
        axes.step(run.episode, run.num_groups, where="post", color=color, linewidth=line)
    highest = max(int(run.num_groups.max()) for run in runs)
    axes.set(ylim=(0, 1.3 * highest))  # room for the labels of the dashed lines
    axes.yaxis.set_major_locator(MaxNLocator(4, integer=True))
    axes.set_ylabel("Groups" if len(runs) == 1 else "Groups\n(gray: others)", fontsize=8)


def _draw_rows(axes: Axes, run: GroupedEpisodes, n_tasks: int, last: int, width: float) -> None:
    numbers = run.numbers
    colors = [color for _, _, color, _ in task_markers([""] * n_tasks)]
    # Points; the width of one episode on the axis, at least 0.4 to stay visible.
    line = max(0.4, 0.85 * 72 * width / last)
    for row, group in enumerate(numbers):
        played = run.episode[run.group == group]
        axes.barh(row, played[-1] - played[0], 0.8, played[0], color="0.94", zorder=0)
        episodes = [run.episode[(run.group == group) & (run.task == t)] for t in range(n_tasks)]
        for task in sorted(range(n_tasks), key=lambda task: -len(episodes[task])):
            marks = axes.vlines(episodes[task], row - 0.4, row + 0.4, colors[task], lw=line)
            marks.set_snap(False)  # Snapping to pixels would leave gaps between neighbors.
    axes.set(ylim=(len(numbers) - 0.4, -0.6))
    each = math.ceil(len(numbers) / 10)
    axes.set_yticks(range(0, len(numbers), each), [str(group) for group in numbers[::each]])
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)
    axes.set_ylabel("Group", fontsize=8)
