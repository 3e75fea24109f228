"""Figure of the groups of behaviors: their number, and the episodes of each."""

from __future__ import annotations

import math
from collections.abc import Sequence

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from bgpo_trl.figures.style import add_legend, mark_starts, style_axes, task_markers
from bgpo_trl.runs.results import Run


def plot_groups(run: Run) -> Figure:
    """Plot the number of groups over training and, for each seed, the episodes of each group.

    Each group that has acted has a row, shaded from its first to its last episode, with a mark for
    each of its episodes in the color of the task. Marks of rarer tasks are drawn on top; the panel
    titles give the purity.

    Raises:
        ValueError: If there are no training episodes.
    """
    if run.training is None or run.training.empty:
        raise ValueError("there is no training episode to show: let the run train first.")
    episodes, tasks = run.training.sort_values(["seed", "episode"]), run.tasks
    last = int(episodes["episode"].max())
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

    mark_starts(panels[0], run.presented, tasks, last)
    _draw_numbers(panels[0], list(seeds.values()))
    for axes, (seed, of_seed) in zip(panels[1:], seeds.items(), strict=True):
        _draw_rows(axes, of_seed, tasks, last, width)
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


def _draw_rows(
    axes: Axes, seed: pd.DataFrame, tasks: Sequence[str], last: int, width: float
) -> None:
    """Draw the episodes of each group of a seed, in a row for each group."""
    colors = {tasks[number]: color for number, _, color, _ in task_markers(tasks)}
    # Points; the width of one episode on the axis, at least 0.4 to stay visible.
    line = max(0.4, 0.85 * 72 * width / last)
    numbers = []
    for row, (number, group) in enumerate(seed.groupby("group")):
        numbers.append(number)
        first, end = group["episode"].iloc[0], group["episode"].iloc[-1]
        axes.barh(row, end - first, 0.8, first, color="0.94", zorder=0)
        episodes = {task: group.loc[group["task"] == task, "episode"] for task in tasks}
        for task in sorted(tasks, key=lambda task: -len(episodes[task])):
            marks = axes.vlines(episodes[task], row - 0.4, row + 0.4, colors[task], lw=line)
            marks.set_snap(False)  # Snapping to pixels would leave gaps between neighbors.
    axes.set(ylim=(len(numbers) - 0.4, -0.6))
    each = math.ceil(len(numbers) / 10)
    axes.set_yticks(range(0, len(numbers), each), [str(number) for number in numbers[::each]])
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)
    axes.set_ylabel("Group", fontsize=8)
