"""Figure of GWR-B: its nodes on their principal components (Fig. 7)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from bgpo_trl.figures.style import add_legend, markers, style_axes, task_markers

_NO_TASK = (-1, "no demonstration", "0.6", "x")
# Paul Tol's muted colors, for groups, so that they are not taken for tasks.
_GROUP_COLORS = ("#332288", "#CC6677", "#117733", "#88CCEE", "#882255", "#DDCC77", "#44AA99")


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
    """
    points, share = _principal_components(np.asarray(weights, dtype=np.float64))
    panels = [(np.asarray(node_task), [*task_markers(task_names), _NO_TASK])]
    if node_group is not None:
        names = {group: f"group {group}" for group in np.unique(node_group).tolist()}
        panels.append((np.asarray(node_group), markers(names, _GROUP_COLORS)))
    width = 4.8
    figure = Figure(figsize=(width * len(panels), 4.6), layout="constrained")
    all_axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for axes, (numbers, marks) in zip(all_axes, panels, strict=True):
        _draw_nodes(axes, points, numbers, marks)
        axes.set_xlabel(f"Principal component 1 ({share[0]:.0%} of variance)", fontsize=9)
        axes.set_ylabel(f"Principal component 2 ({share[1]:.0%} of variance)", fontsize=9)
        axes.set_aspect("equal", adjustable="datalim")
        style_axes(axes)
        handles, labels = axes.get_legend_handles_labels()
        add_legend(axes, handles, labels, width - 0.9)
    return figure


def _principal_components(values: NDArray) -> tuple[NDArray, NDArray]:
    """Return ``[N, 2]`` points on the first two principal components, and their variance shares."""
    centered = values - values.mean(axis=0)
    _, scales, directions = np.linalg.svd(centered, full_matrices=False)
    # The solver's signs are arbitrary; making the largest component positive fixes them.
    largest = np.abs(directions).argmax(axis=1, keepdims=True)
    directions = directions * np.sign(np.take_along_axis(directions, largest, axis=1))
    share = scales[:2] ** 2 / max((scales**2).sum(), np.finfo(float).tiny)
    return centered @ directions[:2].T, share


def _draw_nodes(
    axes: Axes, points: NDArray, numbers: NDArray, marks: Sequence[tuple[int, str, str, str]]
) -> None:
    """Draw the points with each number in its own way, with their count for the legend."""
    for number, name, color, marker in marks:
        chosen = points[numbers == number]
        if len(chosen) == 0:
            continue
        dots = axes.scatter(chosen[:, 0], chosen[:, 1], s=22, c=color, marker=marker, alpha=0.9)
        dots.set(linewidths=0.9 if marker == "x" else 0.4)
        if marker != "x":
            dots.set(edgecolors="w")
        dots.set(label=f"{name} ({len(chosen)})", zorder=2 if number < 0 else 3)
