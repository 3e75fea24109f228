"""Figure of the nodes of a GWR-B on their principal components (Fig. 7)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from bgpo_trl.figures.style import MARKERS, add_legend, style_axes, task_markers

NO_TASK = (-1, "no demonstration", "0.6", "x")
"""Number, legend name, color and marker of nodes without a task."""

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

    Raises:
        ValueError: If the shapes do not match, a weight is not finite, or a task does not exist.
    """
    weights = np.asarray(weights, dtype=np.float64)
    kinds = {"task": np.asarray(node_task)}
    if node_group is not None:
        kinds["group"] = np.asarray(node_group)
    _check(weights, kinds, len(task_names))
    points, share = principal_components(weights)
    marks = {
        "task": [*task_markers(task_names), NO_TASK],
        "group": _group_markers(kinds.get("group", ())),
    }
    width = 4.8
    figure = Figure(figsize=(width * len(kinds), 4.6), layout="constrained")
    panels = figure.subplots(1, len(kinds), squeeze=False)[0]
    for axes, kind in zip(panels, kinds, strict=True):
        _draw_nodes(axes, points, kinds[kind], marks[kind])
        axes.set_xlabel(f"Principal component 1 ({share[0]:.0%} of variance)", fontsize=9)
        axes.set_ylabel(f"Principal component 2 ({share[1]:.0%} of variance)", fontsize=9)
        axes.set_aspect("equal", adjustable="datalim")
        style_axes(axes)
        handles, labels = axes.get_legend_handles_labels()
        add_legend(axes, handles, labels, width - 0.9)
    return figure


def principal_components(values: NDArray, shown: NDArray | None = None) -> tuple[NDArray, NDArray]:
    """Return points on the first two principal components of values, and their variance shares.

    Components are those of ``values`` ``[N, d]``; points ``[M, 2]`` those of ``shown`` ``[M, d]``,
    by default the values. Shares are ``[2]``.
    """
    _, scales, directions = np.linalg.svd(values - values.mean(axis=0), full_matrices=False)
    # The solver's signs are arbitrary; making the largest component positive fixes them.
    largest = np.abs(directions).argmax(axis=1, keepdims=True)
    directions = directions * np.sign(np.take_along_axis(directions, largest, axis=1))
    variance = scales**2
    share = variance[:2] / max(variance.sum(), np.finfo(float).tiny)
    shown = values if shown is None else shown
    return (shown - values.mean(axis=0)) @ directions[:2].T, share


def _check(weights: NDArray, kinds: Mapping[str, NDArray], n_tasks: int) -> None:
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
    if not np.isin(tasks := kinds["task"], np.arange(-1, n_tasks)).all():
        raise ValueError(
            f"node_task must be -1 or a position in the {n_tasks} task_names, "
            f"not {tasks.min()} to {tasks.max()}."
        )


def _group_markers(groups: ArrayLike) -> list[tuple[int, str, str, str]]:
    """Return number, legend name, color and marker of each group."""
    return [
        (
            group,
            f"group {group}",
            _GROUP_COLORS[group % len(_GROUP_COLORS)],
            MARKERS[group % len(MARKERS)],
        )
        for group in np.unique(groups).tolist()
    ]


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
