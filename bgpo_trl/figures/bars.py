"""Bars of success by task and condition."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from numpy.typing import ArrayLike

from bgpo_trl.analysis import statistics
from bgpo_trl.figures.style import COLORS, add_legend, readable, style_axes

_WIDTH = 0.8  # of the bars of a task, whose centers are 1 apart


def plot_success_bars(success: Mapping[str, ArrayLike], tasks: Sequence[str]) -> Figure:
    """Plot the success on each task as a group of bars, one for each condition.

    Bars are means over seeds, with 95 % t intervals if there are at least two seeds, and a dot for
    each seed.

    Args:
        success: Success in [0, 1] of each seed and task, ``[S, T]``, by condition.
        tasks: Names of the tasks.

    Raises:
        ValueError: If there are no conditions, or one has not a column per task.
    """
    found = {name: np.asarray(scores, float) for name, scores in success.items()}
    if not found or any(s.ndim != 2 or s.shape[1] != len(tasks) for s in found.values()):
        shapes = [list(scores.shape) for scores in found.values()]
        raise ValueError(f"success must be [seeds, {len(tasks)}] by condition, got {shapes}")
    width = max(3.6, 1.0 + 0.28 * len(tasks) * len(found))  # inches
    figure = Figure(figsize=(width, 3.2), layout="constrained")
    axes = figure.add_subplot()
    slim = _WIDTH / len(found)
    for number, (name, scores) in enumerate(found.items()):
        mean = scores.mean(0)
        places = np.arange(len(tasks)) + (number - (len(found) - 1) / 2) * slim
        color = COLORS[number % len(COLORS)]
        axes.bar(places, mean, slim * 0.9, color=color, alpha=0.75, label=name)
        if len(scores) > 1:
            low, high = np.clip(np.transpose([statistics.mean(s)[1:] for s in scores.T]), 0.0, 1.0)
            axes.errorbar(
                places, mean, [mean - low, high - mean], fmt="none", ecolor="0.2", elinewidth=0.9
            )
            around = np.linspace(-0.2, 0.2, len(scores)) * slim
            axes.scatter(
                np.add.outer(around, places),
                scores,
                s=4,
                color="0.2",
                linewidths=0,
                zorder=3,
                clip_on=False,
            )
    names = [readable(task).replace(" to ", "\nto ") for task in tasks]
    axes.set_xticks(range(len(tasks)), names)
    axes.set_ylim(0, 1.02)
    axes.set_ylabel("Success rate", fontsize=9)
    axes.yaxis.set_major_formatter(PercentFormatter(1, decimals=0))
    style_axes(axes)
    axes.grid(visible=False, axis="x")
    add_legend(figure, *axes.get_legend_handles_labels(), width)
    return figure
