"""Figure of the growth of GWR-B during a run."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike, NDArray

from bgpo_trl.figures.nodes import NO_TASK, principal_components
from bgpo_trl.figures.style import add_legend, style_axes, task_markers

_COLUMNS = 3
_BOTH_WAYS = np.array([-1.0, 1.0])


def plot_gwr_growth(
    graphs: Mapping[int, tuple[ArrayLike, ArrayLike, ArrayLike]],
    num_nodes: Sequence[ArrayLike],
    task_names: Sequence[str],
) -> Figure:
    """Plot the graph of a GWR-B over time, and its number of nodes below.

    All panels have the same axes: the first two principal components of the last graph's nodes that
    match demonstrations. Nodes far from these (such as GWR-B's two random initial nodes) may lie
    outside; the panel titles give their number.

    Args:
        graphs: By training episode: weights ``[N, d]``, edges ``[E, 2]`` between their rows, and
            the task of each node ``[N]`` with -1 for none, as in `plot_gwr_pca`.
        num_nodes: Number of nodes after each training episode, ``[episodes]`` per seed; the graphs
            belong to the first seed.
        task_names: Names of the tasks.

    Raises:
        ValueError: If there are no graphs.
    """
    if not graphs:
        raise ValueError("there is no graph to show: let the run save some first.")
    graphs = dict(sorted(graphs.items()))
    weights = [np.asarray(graph[0], dtype=np.float64) for graph in graphs.values()]
    tasks = [np.asarray(graph[2]) for graph in graphs.values()]
    nodes, task = np.concatenate(weights), np.concatenate(tasks)
    last = weights[-1][tasks[-1] >= 0]
    points, share = principal_components(last if len(last) > 2 else nodes, nodes)
    matching = points[task >= 0] if (task >= 0).any() else points
    low, high = matching.min(axis=0), matching.max(axis=0)
    middle, half = (low + high) / 2, max(0.6 * (high - low).max(), 1e-3)
    split = np.split(points, np.cumsum([len(w) for w in weights])[:-1])

    n_rows, width = math.ceil(len(graphs) / _COLUMNS), 7.0
    figure = Figure(figsize=(width, 2.4 * n_rows + 2.2), layout="constrained")
    grid = figure.add_gridspec(n_rows + 1, _COLUMNS, height_ratios=[1.0] * n_rows + [0.6])
    kinds = [*task_markers(task_names), NO_TASK]
    kinds = [kind for kind in kinds if (task == kind[0]).any()]
    for position, (episode, graph) in enumerate(graphs.items()):
        axes = figure.add_subplot(grid[divmod(position, _COLUMNS)])
        place = split[position]
        _draw_graph(axes, place, graph[1], tasks[position], kinds)
        outside = int((np.abs(place - middle) > half).any(axis=1).sum())
        title = f"episode {episode:,}: {len(place)} nodes"
        axes.set_title(f"{title}, {outside} outside" if outside else title, fontsize=8)
        axes.set(xlim=middle[0] + half * _BOTH_WAYS, ylim=middle[1] + half * _BOTH_WAYS)
        lowest, leftmost = position + _COLUMNS >= len(graphs), position % _COLUMNS == 0
        axes.tick_params(labelbottom=lowest, labelleft=leftmost)
        axes.set_xlabel(f"component 1 ({share[0]:.0%} of variance)" if lowest else "", fontsize=8)
        axes.set_ylabel(f"component 2 ({share[1]:.0%})" if leftmost else "", fontsize=8)

    axes = figure.add_subplot(grid[n_rows, :])
    _draw_counts(axes, num_nodes, dict(zip(graphs, map(len, weights), strict=True)))
    handles = [Line2D([], [], color=c, marker=m, linestyle="", ms=5) for _, _, c, m in kinds]
    add_legend(figure, handles, [name for _, name, _, _ in kinds], width)
    return figure


def _draw_graph(
    axes: Axes,
    place: NDArray,
    edges: ArrayLike,
    tasks: NDArray,
    kinds: Sequence[tuple[int, str, str, str]],
) -> None:
    """Draw the edges of a graph, and on them its nodes ``[N, 2]`` by kind of task."""
    ends = place[np.asarray(edges).reshape(-1, 2)]
    axes.add_collection(LineCollection(list(ends), colors="0.75", linewidths=0.6))
    for number, _, color, marker in kinds:
        chosen = place[tasks == number]
        axes.scatter(*chosen.T, s=14, c=color, marker=marker, linewidths=0.8, zorder=2)
    axes.set_aspect("equal")
    style_axes(axes)


def _draw_counts(axes: Axes, num_nodes: Sequence[ArrayLike], graphs: Mapping[int, int]) -> None:
    """Draw the number of nodes of each seed, the first seed on top with a dot for each graph."""
    for number, counts in reversed(list(enumerate(num_nodes))):
        counts = np.asarray(counts)
        episodes = np.arange(1, len(counts) + 1)
        color, line = ("0.2", 1.4) if number == 0 else ("0.75", 0.8)
        axes.plot(episodes, counts, color=color, linewidth=line)
    axes.plot(list(graphs), list(graphs.values()), "o", color="0.2", ms=4, clip_on=False)
    axes.set_xlabel("Training episode (gray: the other seeds)", fontsize=8)
    axes.set_ylabel("Nodes", fontsize=8)
    axes.set(xlim=(0, max(graphs)), ylim=(0, None))
    axes.xaxis.set_major_formatter("{x:,.0f}")
    style_axes(axes)
