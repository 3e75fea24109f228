"""Figures of GWR-B: its nodes on their principal components (Fig. 7), and its growth in a run."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike, NDArray

from bgpo_trl.figures.style import MARKERS, add_legend, save_figure, style_axes, task_markers
from bgpo_trl.files.writing import write_whole
from bgpo_trl.runs.results import read_table

if TYPE_CHECKING:
    from bgpo_trl.algorithms import Algorithm
    from bgpo_trl.configs import RunConfig
    from bgpo_trl.data.bank import DemonstrationBank

_NO_TASK = (-1, "no demonstration", "0.6", "x")
# Paul Tol's muted colors, for groups, so that they are not taken for tasks.
_GROUP_COLORS = ("#332288", "#CC6677", "#117733", "#88CCEE", "#882255", "#DDCC77", "#44AA99")
_COLUMNS = 3


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
    points, share = _principal_components(weights)
    marks = {
        "task": [*task_markers(task_names), _NO_TASK],
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


def _principal_components(values: NDArray, shown: NDArray | None = None) -> tuple[NDArray, NDArray]:
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
    points, share = _principal_components(last if len(last) > 2 else nodes, nodes)
    matching = points[task >= 0] if (task >= 0).any() else points
    low, high = matching.min(axis=0), matching.max(axis=0)
    middle, half = (low + high) / 2, max(0.6 * (high - low).max(), 1e-3)
    split = np.split(points, np.cumsum([len(w) for w in weights])[:-1])

    n_rows, width = math.ceil(len(graphs) / _COLUMNS), 7.0
    figure = Figure(figsize=(width, 2.4 * n_rows + 2.2), layout="constrained")
    grid = figure.add_gridspec(n_rows + 1, _COLUMNS, height_ratios=[1.0] * n_rows + [0.6])
    kinds = [*task_markers(task_names), _NO_TASK]
    kinds = [kind for kind in kinds if (task == kind[0]).any()]
    for position, (episode, graph) in enumerate(graphs.items()):
        axes = figure.add_subplot(grid[divmod(position, _COLUMNS)])
        place = split[position]
        _draw_graph(axes, place, graph[1], tasks[position], kinds)
        outside = int((np.abs(place - middle) > half).any(axis=1).sum())
        title = f"episode {episode:,}: {len(place)} nodes"
        axes.set_title(f"{title}, {outside} outside" if outside else title, fontsize=8)
        axes.set_xlim(middle[0] - half, middle[0] + half)
        axes.set_ylim(middle[1] - half, middle[1] + half)
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


def draw_growth(
    run: Path, config: RunConfig, bank: DemonstrationBank, out: Path | None = None
) -> bool:
    """Write ``gwr_growth.png``: the first seed's graph over time, and the number of nodes of all.

    A node has the color of its majority task among the tasks presented by then. The folder is
    ``out``, by default ``figures/`` of the run. Returns False for runs without GWR-B, which save no
    graphs.

    Raises:
        ValueError: If a file of the run is damaged.
    """
    import torch  # here, since tables of results need not wait for it

    from bgpo_trl.analysis.task_inference import majority_task, match_counts
    from bgpo_trl.runs.gwr_graphs import load_graphs
    from bgpo_trl.transforms import TaskSchedule

    networks, n_tasks = load_graphs(run / "gwr"), len(config.task_starts)
    if not networks:
        return False
    graphs = {}
    for episode, gwr in networks.items():
        presented = TaskSchedule(config.task_starts).presented(torch.tensor(episode))
        tasks = majority_task(match_counts(gwr, bank.seen(), n_tasks) * presented)
        graphs[episode] = (gwr.graph().weights, gwr.graph().edges, tasks)
    table = read_table(run / "train.csv")
    nodes = {seed: of_seed.tolist() for seed, of_seed in table.groupby("seed")["num_nodes"]}
    if nodes.keys() != set(config.seeds):
        raise ValueError(
            f"{run / 'train.csv'} does not have the seeds of the run: resume it, or name another"
        )
    figure = plot_gwr_growth(graphs, [nodes[seed] for seed in config.seeds], config.tasks)
    save_figure(figure, (out or run / "figures") / "gwr_growth.png")
    return True


def draw_nodes(
    run: Path, algorithm: Algorithm, bank: DemonstrationBank, tasks: Sequence[str]
) -> None:
    """Write the nodes of the first seed's GWR-B to ``gwr.csv`` and draw them (Fig. 7).

    A row is a node: its majority task (-1 for none), its group, if there are groups, and its
    weights. The bank defines the nodes' majority tasks. Without GWR-B, nothing is written.
    """
    from bgpo_trl.analysis.task_inference import majority_task, match_counts

    if algorithm.gwr is None:
        return
    weights, groups = algorithm.gwr.graph(0).weights, None
    node_tasks = majority_task(match_counts(algorithm.gwr, bank.seen(), len(tasks))[0])
    node_tasks = node_tasks[: len(weights)]
    if algorithm.groups:
        groups = algorithm.groups[0].lookup(weights).group
    table = pd.DataFrame(weights.numpy()).add_prefix("w")
    if groups is not None:
        table.insert(0, "group", groups.numpy())
    table.insert(0, "task", node_tasks.numpy())
    text = table.to_csv(index=False, float_format="%.6g", lineterminator="\r\n")
    write_whole(run / "gwr.csv", text)
    save_figure(plot_gwr_pca(weights, node_tasks, tasks, groups), run / "figures" / "gwr.png")
