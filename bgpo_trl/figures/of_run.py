"""Figures of GWR-B and the groups of behaviors, drawn from the files of a run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd
import torch
from torch import Tensor

from bgpo_trl.analysis.task_inference import majority_task, match_counts
from bgpo_trl.configs import RunConfig
from bgpo_trl.figures.gwr import plot_gwr_growth, plot_gwr_pca
from bgpo_trl.figures.style import save_figure
from bgpo_trl.files.writing import write_whole
from bgpo_trl.runs.gwr_graphs import load_graphs
from bgpo_trl.runs.results import COUNT, read_table

if TYPE_CHECKING:
    from bgpo_trl.algorithms import Algorithm
    from bgpo_trl.data.bank import DemonstrationBank


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
    from bgpo_trl.transforms import TaskSchedule

    networks, n_tasks = load_graphs(run / "gwr"), len(config.task_starts)
    if not networks:
        return False
    graphs = {}
    for episode, gwr in networks.items():
        presented = TaskSchedule(config.task_starts).presented(torch.tensor(episode))
        tasks = majority_task(match_counts(gwr, bank.seen(), n_tasks) * presented)
        graphs[episode] = (gwr.graph().weights, gwr.graph().edges, tasks)
    path = run / "train.csv"
    table = read_table(path, {"seed": COUNT, "num_nodes": COUNT})
    nodes = {seed: of_seed.tolist() for seed, of_seed in table.groupby("seed")["num_nodes"]}
    if nodes.keys() != set(config.seeds):
        raise ValueError(f"{path} does not have the seeds of the run: resume it, or name another")
    figure = plot_gwr_growth(graphs, [nodes[seed] for seed in config.seeds], config.tasks)
    save_figure(figure, (out or run / "figures") / "gwr_growth.png")
    return True


def draw_nodes(
    run: Path, algorithm: Algorithm, bank: DemonstrationBank, tasks: Sequence[str]
) -> None:
    """Write the nodes of the first seed's GWR-B to ``gwr.csv`` and draw them (Fig. 7).

    The bank defines the nodes' majority tasks. Without GWR-B, nothing is written.
    """
    if algorithm.gwr is None:
        return
    weights, groups = algorithm.gwr.graph(0).weights, None
    node_tasks = majority_task(match_counts(algorithm.gwr, bank.seen(), len(tasks))[0])
    node_tasks = node_tasks[: len(weights)]
    if algorithm.groups is not None:
        batch = algorithm.groups.batch_size
        groups = algorithm.groups.lookup(weights.expand(*batch, *weights.shape)).group[0]
    write_nodes(run / "gwr.csv", weights, node_tasks, groups)
    save_figure(plot_gwr_pca(weights, node_tasks, tasks, groups), run / "figures" / "gwr.png")


def write_nodes(path: Path, weights: Tensor, tasks: Tensor, groups: Tensor | None = None) -> None:
    """Write nodes ``[N]`` as CSV: majority task (-1: none), group if given, weights ``[N, d]``."""
    table = pd.DataFrame(weights.numpy()).add_prefix("w")
    if groups is not None:
        table.insert(0, "group", groups.numpy())
    table.insert(0, "task", tasks.numpy())
    write_whole(path, table.to_csv(index=False, float_format="%.6g", lineterminator="\r\n"))
