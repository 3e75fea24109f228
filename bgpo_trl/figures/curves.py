"""Learning curves (Figs. 6, 8, 9), nodes of GWR-B (Fig. 7) and frame strips.

Figures are drawn without pyplot, hence without global state, and the same data always gives the
same file. Colors are Okabe and Ito's colorblind-safe palette; line styles and markers differ as
well.
"""

from __future__ import annotations

import math
import os
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike, NDArray

from bgpo_trl.files.folders import make_folder
from bgpo_trl.runs.results import read_tests

_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
_LINES = ("-", "--", "-.", (0, (3, 1, 1, 1, 1, 1)), (0, (1, 1)), (0, (6, 2)))
_MARKERS = ("o", "s", "^", "D", "v", "P")
# Paul Tol's muted colors, for groups, so that they are not taken for tasks.
_GROUP_COLORS = ("#332288", "#CC6677", "#117733", "#88CCEE", "#882255", "#DDCC77", "#44AA99")
_GRID_POINTS = 400
_OVERALL = "All presented tasks"

_Tests = dict[str, dict[int, list[tuple[int, str, float]]]]
"""Training episode, task and success of each test episode, by algorithm and seed."""


def plot_success_curves(
    eval_csv: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    *,
    presented: Mapping[str, int] | None = None,
    random_success: Mapping[str, float] | None = None,
    window: int | None = None,
    last: int | None = None,
    names: Mapping[str, str] | None = None,
) -> Figure:
    """Plot success against training episodes, in one panel for all tasks and one for each.

    A seed's curve at episode e is its share of successes among the test episodes after training
    episodes (e - window, e]. This trailing mean never shows success before it occurred. Lines are
    means over seeds with a test episode in the window, shaded by one standard deviation
    (``ddof=0``), as in the paper.

    Args:
        eval_csv: One or more ``eval.csv`` files, which may hold several algorithms and seeds.
        presented: Training episode from which each task is presented, by task name, in the order
            of the panels. Starts after the first are marked with dashed lines.
        random_success: Success rate of a random policy by task, marked with dotted lines.
        window: Length of the trailing mean in training episodes; 5 % of the training if ``None``.
        last: Training episode at which the curves end; by default that of the longest.
        names: Legend names by algorithm, in legend order; other algorithms follow under their own
            names.

    Returns:
        The figure.

    Raises:
        ValueError: If a file is not an ``eval.csv``, there are no test episodes, or the window is
            not positive.
    """
    tests = _read_tests([eval_csv] if isinstance(eval_csv, str | os.PathLike) else eval_csv)
    names = names or {}
    order = [*(name for name in names if name in tests), *(n for n in tests if n not in names)]
    tests = {name: tests[name] for name in order}
    presented = presented or {}
    random_success = random_success or {}
    found = {task for seeds in tests.values() for rows in seeds.values() for _, task, _ in rows}
    tasks = [*presented, *sorted(found - set(presented))]
    if last is None:
        last = max(row[0] for seeds in tests.values() for rows in seeds.values() for row in rows)
    window = max(1, round(last / 20)) if window is None else window
    if window < 1:
        raise ValueError(f"window must be at least 1 episode, not {window}.")

    n_columns = 2 if len(tasks) in (1, 2, 3) else 3
    n_rows = math.ceil((len(tasks) + 1) / n_columns)
    width = 3.5 * n_columns
    figure = Figure(figsize=(width, 2.4 * n_rows + 0.5))
    # Padding keeps the tick labels of neighboring panels apart.
    figure.set_layout_engine("constrained", w_pad=0.1)
    panels = figure.subplots(n_rows, n_columns, sharex=True, sharey=True, squeeze=False).ravel()
    tested = {row[0] for seeds in tests.values() for rows in seeds.values() for row in rows}
    grid = np.array(sorted(episode for episode in tested if episode <= last))
    if len(grid) > _GRID_POINTS:
        grid = np.unique(np.linspace(0, last, _GRID_POINTS).round().astype(int))

    for panel, task in zip(panels, [None, *tasks], strict=False):
        for index, (algorithm, seeds) in enumerate(tests.items()):
            curves = [_trailing_mean(rows, task, grid, window) for rows in seeds.values()]
            _draw_curve(panel, grid, np.array(curves), names.get(algorithm, algorithm), index)
        starts = {name: episode for name, episode in presented.items() if task in (None, name)}
        _mark_starts(panel, starts, tasks, last)
        if task is not None and task in random_success:
            panel.axhline(random_success[task], color="0.35", linestyle=":", linewidth=1.2)
        panel.set_title(
            _OVERALL if task is None else f"Task {tasks.index(task) + 1}: {_readable(task)}",
            fontsize=9,
        )
        _style(panel)
        # The room above 1 takes the labels of the dashed lines.
        panel.set(xlim=(0, last), ylim=(0, 1.1), yticks=np.linspace(0, 1, 6))
        panel.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10], integer=True))
        panel.xaxis.set_major_formatter("{x:,.0f}")
    for panel in panels[len(tasks) + 1 :]:
        panel.remove()
    for position, panel in enumerate(panels[: len(tasks) + 1]):
        # The lowest panel of each column carries the tick labels.
        if position + n_columns > len(tasks):
            panel.tick_params(labelbottom=True)

    figure.supxlabel(f"Training episode (success: mean over the last {window:,})", fontsize=9)
    figure.supylabel("Success rate", fontsize=9)
    handles, labels = panels[0].get_legend_handles_labels()
    if random_success:
        handles += [panels[0].plot([], [], color="0.35", linestyle=":", linewidth=1.2)[0]]
        labels += ["random policy"]
    _legend(figure, handles, labels, width)
    return figure


def plot_gwr_pca(
    weights: ArrayLike,
    node_task: ArrayLike,
    task_names: Sequence[str],
    node_group: ArrayLike | None = None,
) -> Figure:
    """Plot the nodes of a GWR-B on their first two principal components (Fig. 7 of the paper).

    Args:
        weights: Weights of the nodes ``[N, d]``, with ``N`` and ``d`` at least 2.
        node_task: Majority task of each node as a position in ``task_names``, ``[N]``; -1 for nodes
            that are the best-matching unit of no demonstration.
        task_names: Names of the tasks.
        node_group: Group of each node, ``[N]``, shown in a second panel; ``None`` for no panel.

    Returns:
        The figure.

    Raises:
        ValueError: If the shapes do not match, a weight is not finite, or a task does not exist.
    """
    weights = np.asarray(weights, dtype=np.float64)
    kinds = {"task": np.asarray(node_task)}
    if node_group is not None:
        kinds["group"] = np.asarray(node_group)
    if weights.ndim != 2 or min(weights.shape) < 2 or not np.isfinite(weights).all():
        raise ValueError(
            f"weights must be finite and [N, d] with N, d >= 2, not {list(weights.shape)}."
        )
    for kind, numbers in kinds.items():
        if numbers.shape != weights.shape[:1]:
            raise ValueError(
                f"node_{kind} must have one {kind} for each of the {len(weights)} nodes, "
                f"not the shape {list(numbers.shape)}."
            )
    if not np.isin(tasks := kinds["task"], np.arange(-1, len(task_names))).all():
        raise ValueError(
            f"node_task must be -1 or a position in the {len(task_names)} task_names, "
            f"not {tasks.min()} to {tasks.max()}."
        )

    points, share = _principal_components(weights)
    marks = {
        "task": [*_task_markers(task_names), (-1, "no demonstration", "0.6", "x")],
        "group": [
            (
                group,
                f"group {group}",
                _GROUP_COLORS[group % len(_GROUP_COLORS)],
                _MARKERS[group % 6],
            )
            for group in np.unique(kinds.get("group", [])).tolist()
        ],
    }
    width = 4.8
    figure = Figure(figsize=(width * len(kinds), 4.6), layout="constrained")
    panels = figure.subplots(1, len(kinds), squeeze=False)[0]
    for axes, kind in zip(panels, kinds, strict=True):
        for number, name, color, marker in marks[kind]:
            chosen = points[kinds[kind] == number]
            if len(chosen) == 0:
                continue
            dots = axes.scatter(chosen[:, 0], chosen[:, 1], s=22, c=color, marker=marker, alpha=0.9)
            dots.set(linewidths=0.9 if marker == "x" else 0.4)
            if marker != "x":
                dots.set(edgecolors="w")
            dots.set(label=f"{name} ({len(chosen)})", zorder=2 if number < 0 else 3)
        axes.set_xlabel(f"Principal component 1 ({share[0]:.0%} of variance)", fontsize=9)
        axes.set_ylabel(f"Principal component 2 ({share[1]:.0%} of variance)", fontsize=9)
        axes.set_aspect("equal", adjustable="datalim")
        _style(axes)
        handles, labels = axes.get_legend_handles_labels()
        _legend(axes, handles, labels, width - 0.9)
    return figure


def plot_frame_strips(episodes: Mapping[str, NDArray], n_frames: int = 8) -> Figure:
    """Show episodes as rows of frames, from the first to the last.

    Args:
        episodes: Frames uint8 ``[N, 32, 64, 3]`` by row title.
        n_frames: Maximum number of frames per row, evenly spaced in time.

    Returns:
        The figure.

    Raises:
        ValueError: If there are no episodes, or one has no frames.
    """
    if not episodes or any(len(frames) == 0 for frames in episodes.values()):
        raise ValueError("there is nothing to show: give episodes of at least one frame.")
    figure = Figure(figsize=(1.3 * n_frames, 1.05 * len(episodes)))
    figure.set_layout_engine("constrained", h_pad=0.16)  # room for the titles of the rows
    panels = figure.subplots(len(episodes), n_frames, squeeze=False)
    for row, (title, frames) in zip(panels, episodes.items(), strict=True):
        shown = np.unique(np.linspace(0, len(frames) - 1, n_frames).round().astype(int))
        for panel in row:
            panel.set_axis_off()
        for panel, index in zip(row, shown, strict=False):
            panel.imshow(frames[index], interpolation="nearest")
            panel.set_title(f"step {index}", fontsize=6, pad=2)
        label = row[0].annotate(
            title, (0, 1), xytext=(0, 11), xycoords="axes fraction", textcoords="offset points"
        )
        label.set(fontsize=7, in_layout=False)  # A long title must not widen its column.
    return figure


def save_figure(figure: Figure, path: str | os.PathLike[str]) -> None:
    """Save a figure at 300 dpi; the same figure always gives the same bytes.

    Args:
        figure: The figure.
        path: File ending in ``.png``; its folder is made if missing.
    """
    path = Path(path)
    make_folder(path.parent)
    figure.savefig(path, format="png", dpi=300, metadata={"Software": None})


def _read_tests(paths: Iterable[str | os.PathLike[str]]) -> _Tests:
    tests: _Tests = defaultdict(lambda: defaultdict(list))
    for path in paths:
        for row in read_tests(path):
            test = (int(row["episode"]), row["task"], float(row["success"]))
            tests[row["algorithm"]][int(row["seed"])].append(test)
    if not tests:
        raise ValueError("there are no test episodes to plot: let the run evaluate first.")
    return tests


def _trailing_mean(
    rows: list[tuple[int, str, float]], task: str | None, grid: NDArray, window: int
) -> NDArray:
    """Return a seed's success rate at each grid point; NaN without test episodes in the window."""
    chosen = sorted((episode, success) for episode, name, success in rows if task in (None, name))
    episodes = np.array([episode for episode, _ in chosen])
    successes = np.cumsum([0.0, *(success for _, success in chosen)])
    stop = np.searchsorted(episodes, grid, side="right")
    start = np.searchsorted(episodes, grid - window, side="right")
    count = stop - start
    return np.where(count > 0, (successes[stop] - successes[start]) / np.maximum(count, 1), np.nan)


def _draw_curve(axes: Axes, grid: NDArray, curves: NDArray, name: str, index: int) -> None:
    seeds = np.ma.masked_invalid(curves)
    mean, spread = seeds.mean(axis=0).filled(np.nan), seeds.std(axis=0).filled(np.nan)
    color = _COLORS[index % len(_COLORS)]
    label = f"{name} ({len(curves)} seed{'s' if len(curves) > 1 else ''})"
    axes.plot(
        grid, mean, color=color, linestyle=_LINES[index % len(_LINES)], linewidth=1.6, label=label
    )
    low, high = np.clip(mean - spread, 0, 1), np.clip(mean + spread, 0, 1)
    axes.fill_between(grid, low, high, color=color, alpha=0.18, linewidth=0)


def _mark_starts(axes: Axes, starts: Mapping[str, int], tasks: Sequence[str], last: int) -> None:
    for task, episode in starts.items():
        if not 0 < episode < last:
            continue
        axes.axvline(episode, color="0.35", linestyle=(0, (4, 3)), linewidth=0.9)
        axes.annotate(
            f"task {tasks.index(task) + 1}",
            (episode, 1.05 / 1.1),
            xycoords=axes.get_xaxis_transform(),
            xytext=(3, 0),
            textcoords="offset points",
            va="center",
            fontsize=7.5,
            color="0.25",
        )


def _task_markers(task_names: Sequence[str]) -> list[tuple[int, str, str, str]]:
    return [
        (
            task,
            f"task {task + 1}: {_readable(name)}",
            _COLORS[task % len(_COLORS)],
            _MARKERS[task % len(_MARKERS)],
        )
        for task, name in enumerate(task_names)
    ]


def _principal_components(values: NDArray, shown: NDArray | None = None) -> tuple[NDArray, NDArray]:
    """Return points on the first two principal components of values, and their variance shares.

    The points are ``shown``, or the values themselves if ``None``.
    """
    _, scales, directions = np.linalg.svd(values - values.mean(axis=0), full_matrices=False)
    # The solver's signs are arbitrary; making the largest component positive fixes them.
    largest = np.abs(directions).argmax(axis=1, keepdims=True)
    directions = directions * np.sign(np.take_along_axis(directions, largest, axis=1))
    variance = scales**2
    share = variance[:2] / max(variance.sum(), np.finfo(float).tiny)
    shown = values if shown is None else shown
    return (shown - values.mean(axis=0)) @ directions[:2].T, share


def _readable(name: str) -> str:
    return name.replace("_", " ")


def _style(axes: Axes) -> None:
    axes.tick_params(labelsize=8, length=3)
    axes.grid(color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _legend(above: Figure | Axes, handles: list[Any], labels: list[str], width: float) -> None:
    # Inches: a letter of this size is about 0.065 wide, a handle with its gaps 0.55.
    sizes = [0.065 * len(label) + 0.55 for label in labels]
    columns = len(labels) if sum(sizes) <= width else max(1, int(width / max(sizes)))
    outside: dict[str, Any] = {"loc": "outside upper center"}
    if isinstance(above, Axes):
        outside = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0)}
    above.legend(handles, labels, ncols=columns, fontsize=8.5, frameon=False, **outside)
