"""Figure of learning curves (Figs. 6, 8, 9)."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from bgpo_trl.figures.style import COLORS, LINES, add_legend, mark_starts, readable, style_axes
from bgpo_trl.runs.results import read_tests

_CHANCE: dict[str, Any] = {"color": "0.35", "linestyle": ":", "linewidth": 1.2}
_GRID_POINTS = 400
_OVERALL = "All presented tasks"

_Path = str | os.PathLike[str]


def plot_success_curves(
    eval_csv: str | os.PathLike[str] | Sequence[_Path] | Mapping[str, _Path],
    *,
    presented: Mapping[str, int] | None = None,
    random_success: Mapping[str, float] | None = None,
    window: int | None = None,
    last: int | None = None,
) -> Figure:
    """Plot success against training episodes, in one panel for all tasks and one for each.

    A seed's curve at episode e is its share of successes among the test episodes after training
    episodes (e - window, e]. This trailing mean never shows success before it occurred. Lines are
    means over seeds with a test episode in the window, shaded by one standard deviation
    (``ddof=0``), as in the paper.

    Args:
        eval_csv: One or more ``eval.csv`` files, which may hold several algorithms and seeds; or
            files of one run each, by legend name.
        presented: Training episode from which each task is presented, by task name, in the order of
            the panels. Starts after the first are marked with dashed lines.
        random_success: Success rate of a random policy by task, marked with dotted lines.
        window: Length of the trailing mean in training episodes; 5 % of the training if ``None``.
        last: Training episode at which the curves end; by default that of the longest.

    Raises:
        ValueError: If a file is not an ``eval.csv``, there are no test episodes, or the window is
            not positive.
    """
    presented, random_success = presented or {}, random_success or {}
    tests = _read_tests([eval_csv] if isinstance(eval_csv, str | os.PathLike) else eval_csv)
    tasks = [*presented, *sorted(set(tests["task"]) - set(presented))]
    last = int(tests["episode"].max()) if last is None else last
    window = max(1, round(last / 20)) if window is None else window
    if window < 1:
        raise ValueError(f"window must be at least 1 episode, not {window}.")

    seeds_of = {
        str(name): of_run.unique() for name, of_run in tests.groupby("name", sort=False)["seed"]
    }
    figure, panels = _make_panels(len(tasks))
    grid = _grid(tests["episode"].unique(), last)
    for panel, task in zip(panels.flat, [None, *tasks], strict=False):
        of_panel = tests if task is None else tests[tests["task"] == task]
        for index, (name, seeds) in enumerate(seeds_of.items()):
            of_run = of_panel[of_panel["name"] == name]
            curves = [
                _trailing_mean(of_run[of_run["seed"] == seed], grid, window) for seed in seeds
            ]
            _draw_curve(panel, grid, np.array(curves), name, index)
        starts = {name: episode for name, episode in presented.items() if task in (None, name)}
        mark_starts(panel, starts, tasks, last)
        if task is not None and task in random_success:
            panel.axhline(random_success[task], **_CHANCE)
        title = _OVERALL if task is None else f"Task {tasks.index(task) + 1}: {readable(task)}"
        _style_panel(panel, title, last)
    _tidy_panels(panels, len(tasks))
    _add_labels(figure, window, chance=bool(random_success))
    return figure


def _read_tests(paths: Sequence[_Path] | Mapping[str, _Path]) -> pd.DataFrame:
    """Return the test episodes in files; ``name`` is that of the file or of the algorithm."""
    if not paths:
        raise ValueError("there are no test episodes to plot: let the run evaluate first.")
    if isinstance(paths, Mapping):
        tables = [read_tests(path).assign(name=name) for name, path in paths.items()]
    else:
        tables = [table.assign(name=table["algorithm"]) for table in map(read_tests, paths)]
    return pd.concat(tables, ignore_index=True)


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
    # The room above 1 takes the labels of the dashed lines.
    panel.set(xlim=(0, last), ylim=(0, 1.1), yticks=np.linspace(0, 1, 6))
    panel.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10], integer=True))
    panel.xaxis.set_major_formatter("{x:,.0f}")


def _tidy_panels(panels: NDArray, n_tasks: int) -> None:
    """Remove the panels that are not needed, and give the lowest of each column tick labels."""
    for panel in panels.flat[n_tasks + 1 :]:
        panel.remove()
    for position, panel in enumerate(panels.flat[: n_tasks + 1]):
        if position + panels.shape[1] > n_tasks:
            panel.tick_params(labelbottom=True)


def _add_labels(figure: Figure, window: int, *, chance: bool) -> None:
    figure.supxlabel(f"Training episode (success: mean over the last {window:,})", fontsize=9)
    figure.supylabel("Success rate", fontsize=9)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    if chance:
        handles += figure.axes[0].plot([], [], **_CHANCE)
        labels += ["random policy"]
    add_legend(figure, handles, labels, figure.get_figwidth())


def _grid(tested: NDArray, last: int) -> NDArray:
    """Return the episodes at which curves are drawn: those with tests, or fewer."""
    grid = np.sort(tested[tested <= last])
    if len(grid) > _GRID_POINTS:
        grid = np.unique(np.linspace(0, last, _GRID_POINTS).round().astype(int))
    return grid


def _trailing_mean(tests: pd.DataFrame, grid: NDArray, window: int) -> NDArray:
    """Return a seed's success rate at each grid point; NaN without test episodes in the window."""
    tests = tests.sort_values("episode")
    episodes = tests["episode"].to_numpy()
    successes = np.cumsum([0.0, *tests["success"]])
    stop = np.searchsorted(episodes, grid, side="right")
    start = np.searchsorted(episodes, grid - window, side="right")
    count = stop - start
    return np.where(count > 0, (successes[stop] - successes[start]) / np.maximum(count, 1), np.nan)


def _draw_curve(axes: Axes, grid: NDArray, curves: NDArray, name: str, index: int) -> None:
    seeds = np.ma.masked_invalid(curves)
    mean, spread = seeds.mean(axis=0).filled(np.nan), seeds.std(axis=0).filled(np.nan)
    color = COLORS[index % len(COLORS)]
    label = f"{name} ({len(curves)} seed{'s' if len(curves) > 1 else ''})"
    axes.plot(
        grid, mean, color=color, linestyle=LINES[index % len(LINES)], linewidth=1.6, label=label
    )
    low, high = np.clip(mean - spread, 0, 1), np.clip(mean + spread, 0, 1)
    axes.fill_between(grid, low, high, color=color, alpha=0.18, linewidth=0)
