"""Figures of success and its steps: learning curves (Figs. 6, 8, 9), matrices by phase."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from bgpo_trl.figures.style import (
    COLORS,
    LINES,
    add_legend,
    mark_starts,
    readable,
    style_axes,
)
from bgpo_trl.runs.results import Run

_DOTTED: dict[str, Any] = {"color": "0.35", "linestyle": ":", "linewidth": 1.2}
_GRID_POINTS = 400
_OVERALL = "All presented tasks"


def plot_success_curves(runs: Mapping[str, Run], *, window: int | None = None) -> Figure:
    """Plot success against training episodes, in one panel for all tasks and one for each.

    A seed's curve at episode e is its share of successes among the test episodes after training
    episodes (e - window, e]. This trailing mean never shows success before it occurred. Lines are
    means over seeds with a test episode in the window, shaded by one standard deviation
    (``ddof=0``), as in the paper.

    Dashed lines mark the presentation of later tasks. Dotted lines mark the success of random
    actions, if the summary of the first run has it.

    Args:
        runs: Runs of the same tasks, by legend name.
        window: Length of the trailing mean in training episodes; 5 % of the training if ``None``.

    Raises:
        ValueError: If there are no tests.
    """
    figure, window, _ = _plot_curves(runs, "success", "random_success", "random policy", window)
    figure.supxlabel(f"Training episode (success: mean over the last {window:,})", fontsize=9)
    figure.supylabel("Success rate", fontsize=9)
    for panel in figure.axes:
        # The room above 1 takes the labels of the dashed lines.
        panel.set(ylim=(0, 1.1), yticks=np.linspace(0, 1, 6))
    return figure


def plot_step_curves(runs: Mapping[str, Run], *, window: int | None = None) -> Figure:
    """Plot the steps that a success takes, as `plot_success_curves` plots success.

    Test episodes without success are left out. Dotted lines mark the mean steps of demonstrations.

    Raises:
        ValueError: If the steps of no success are known.
    """
    figure, window, highest = _plot_curves(
        runs, "steps", "demonstrated_steps", "demonstrations", window
    )
    figure.supxlabel(f"Training episode (steps: mean over the last {window:,})", fontsize=9)
    figure.supylabel("Steps of a success", fontsize=9)
    for panel in figure.axes:
        panel.set_ylim(0, 1.1 * highest)
    return figure


def _plot_curves(
    runs: Mapping[str, Run], column: str, reference: str, reference_name: str, window: int | None
) -> tuple[Figure, int, float]:
    """Return a figure of the trailing means of a column of the tests, their window, and the top.

    The summary of the first run has values by task at the entry ``reference``, which are drawn as
    dotted lines.
    """
    tests = {
        name: run.tests if column == "success" else run.tests[run.tests["success"] == 1]
        for name, run in runs.items()
    }
    values = [of_run[column] for of_run in tests.values()]
    if not values or pd.concat(values).isna().all():
        raise ValueError(f"there is no {column} to plot: let the run train longer")
    first, top = next(iter(runs.values())), float(pd.concat(values).max())
    marked = first.summary.get(reference) or {}
    tasks, presented = first.tasks, first.presented
    last = max(run.last for run in runs.values())
    window = max(1, round(last / 20)) if window is None else window

    figure, panels = _make_panels(len(tasks))
    grid = np.unique(np.concatenate([run.episodes for run in runs.values()]))
    if len(grid) > _GRID_POINTS:
        grid = np.unique(np.linspace(0, last, _GRID_POINTS).round().astype(int))
    for panel, task in zip(panels.flat, [None, *tasks], strict=False):
        for index, (name, run) in enumerate(runs.items()):
            of_run = tests[name]
            of_panel = of_run if task is None else of_run[of_run["task"] == task]
            curves = [
                _trailing_mean(of_panel[of_panel["seed"] == seed], column, grid, window)
                for seed in run.seeds
            ]
            _draw_curve(panel, grid, np.array(curves), name, index, top)
        starts = {name: episode for name, episode in presented.items() if task in (None, name)}
        mark_starts(panel, starts, tasks, last)
        if task in marked:
            panel.axhline(marked[task], **_DOTTED)
        title = _OVERALL if task is None else f"Task {tasks.index(task) + 1}: {readable(task)}"
        _style_panel(panel, title, last)
    _tidy_panels(panels, len(tasks))
    handles, labels = figure.axes[0].get_legend_handles_labels()
    if marked:
        handles += figure.axes[0].plot([], [], **_DOTTED)
        labels += [reference_name]
    add_legend(figure, handles, labels, figure.get_figwidth())
    return figure, window, max([top, *marked.values()])


def _make_panels(n_tasks: int) -> tuple[Figure, NDArray]:
    """Return a figure with a panel for all tasks and one for each, ``[rows, columns]``."""
    n_columns = 2 if n_tasks in (1, 2, 3) else 3
    n_rows = math.ceil((n_tasks + 1) / n_columns)
    figure = Figure(figsize=(3.5 * n_columns, 2.4 * n_rows + 0.5))
    # Padding keeps the tick labels of neighboring panels apart.
    figure.set_layout_engine("constrained", w_pad=0.1)
    return figure, figure.subplots(n_rows, n_columns, sharex=True, sharey=True, squeeze=False)


def _style_panel(panel: Axes, title: str, last: int) -> None:
    panel.set_title(title, fontsize=9)
    style_axes(panel)
    panel.set_xlim(0, last)
    panel.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10], integer=True))
    panel.xaxis.set_major_formatter("{x:,.0f}")


def _tidy_panels(panels: NDArray, n_tasks: int) -> None:
    """Remove the panels that are not needed, and give the lowest of each column tick labels."""
    for panel in panels.flat[n_tasks + 1 :]:
        panel.remove()
    for position, panel in enumerate(panels.flat[: n_tasks + 1]):
        if position + panels.shape[1] > n_tasks:
            panel.tick_params(labelbottom=True)


def _trailing_mean(tests: pd.DataFrame, column: str, grid: NDArray, window: int) -> NDArray:
    """Return a seed's trailing mean at each grid point; NaN without values in the window."""
    tests = tests[tests[column].notna()].sort_values("episode")
    episodes = tests["episode"].to_numpy()
    total = np.cumsum([0.0, *tests[column]])
    stop = np.searchsorted(episodes, grid, side="right")
    start = np.searchsorted(episodes, grid - window, side="right")
    count = stop - start
    return np.where(count > 0, (total[stop] - total[start]) / np.maximum(count, 1), np.nan)


def _draw_curve(
    axes: Axes, grid: NDArray, curves: NDArray, name: str, index: int, top: float
) -> None:
    """Draw the mean of curves ``[S, E]``, and their spread as far as it is between 0 and top."""
    seeds = np.ma.masked_invalid(curves)
    mean, spread = seeds.mean(axis=0).filled(np.nan), seeds.std(axis=0).filled(np.nan)
    color = COLORS[index % len(COLORS)]
    label = f"{name} ({len(curves)} seed{'s' if len(curves) > 1 else ''})"
    axes.plot(
        grid, mean, color=color, linestyle=LINES[index % len(LINES)], linewidth=1.6, label=label
    )
    low, high = np.clip(mean - spread, 0, top), np.clip(mean + spread, 0, top)
    axes.fill_between(grid, low, high, color=color, alpha=0.18, linewidth=0)


_MATRICES = 3  # side by side
# Of viridis, on which white letters are readable up to about this height.
_COLOR_MAP, _WHITE_BELOW = "viridis", 0.6


def plot_success_matrices(matrices: Mapping[str, NDArray], tasks: Sequence[str]) -> Figure:
    """Plot ``R[i, j]``, success on task j after the phase of task i, in a panel for each run.

    Cells give percent; tasks that have not been presented stay white. A task that is forgotten
    fades down its column.

    Args:
        matrices: Success in [0, 1] by title, ``[T, T]``; NaN for tasks that were not tested.
        tasks: Names of the tasks, in the order of their presentation.
    """
    n_columns = min(_MATRICES, len(matrices))
    n_rows = math.ceil(len(matrices) / n_columns)
    side = 0.31 * len(tasks)  # inches
    # Titles of panels of few tasks are longer than these; a letter is about 0.08 wide.
    width = max(side, 0.08 * max(map(len, matrices)))
    figure = Figure(figsize=(width * n_columns + 2.9, (side + 0.45) * n_rows + 0.5))
    figure.set_layout_engine("constrained", w_pad=0.08, h_pad=0.08)
    panels = figure.subplots(n_rows, n_columns, squeeze=False).flat
    for number, (title, matrix) in enumerate(matrices.items()):
        panel = panels[number]
        image = _draw_matrix(panel, matrix)
        panel.set_title(title, fontsize=9)
        _label_tasks(panel, tasks, names=number % n_columns == 0)
    for panel in panels[len(matrices) :]:
        panel.remove()
    figure.supxlabel("Success on task", fontsize=9)
    figure.supylabel("After the phase of task", fontsize=9)
    bar = figure.colorbar(image, ax=figure.axes, shrink=0.8, aspect=30, pad=0.02)
    bar.ax.tick_params(labelsize=8)
    bar.set_label("Success rate", fontsize=9)
    return figure


def _draw_matrix(panel: Axes, matrix: NDArray) -> AxesImage:
    image = panel.imshow(matrix, cmap=_COLOR_MAP, vmin=0, vmax=1)
    for (row, column), success in np.ndenumerate(matrix):
        if np.isfinite(success):
            color = "w" if success < _WHITE_BELOW else "k"
            text = f"{100 * success:.0f}"
            panel.text(column, row, text, ha="center", va="center", fontsize=7, color=color)
    return image


def _label_tasks(panel: Axes, tasks: Sequence[str], *, names: bool) -> None:
    """Label the axes with the numbers of the tasks, and the rows with their names if asked."""
    numbers = [str(number) for number in range(1, len(tasks) + 1)]
    rows = [f"{number}: {readable(task)}" for number, task in zip(numbers, tasks, strict=True)]
    panel.set_xticks(range(len(tasks)), numbers)
    panel.set_yticks(range(len(tasks)), rows if names else numbers)
    panel.tick_params(labelsize=8, length=0)
    panel.spines[:].set_visible(False)
