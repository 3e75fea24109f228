"""How GWR-B grew during a run, from the graphs that the run kept."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

import torch

from bgpo_trl.configs import RunConfig
from bgpo_trl.demonstration_bank import DemonstrationBank
from bgpo_trl.gwr_growth import load_graphs
from bgpo_trl.plotting import save_figure
from bgpo_trl.plotting_growth import plot_gwr_growth
from bgpo_trl.runs import count, read_rows
from bgpo_trl.task_inference import majority_task, match_counts


def draw_growth(
    run: Path, config: RunConfig, bank: DemonstrationBank, out: Path | None = None
) -> bool:
    """Writes ``gwr_growth.png``: the first seed's graph over time, and how many nodes all have.

    A node has the color of the task of most demonstrations that it matches, of the tasks that had
    been presented by then.

    Args:
        run: Directory of the run.
        config: The run.
        bank: Its demonstrations.
        out: Folder of the figure; ``figures/`` of the run if None.

    Returns:
        Whether there was anything to draw: runs without GWR-B keep no graphs.

    Raises:
        ValueError: If a file of the run is damaged.
    """
    networks, n_tasks = load_graphs(run / "gwr"), len(config.task_starts)
    if not networks:
        return False
    graphs = {}
    for episode, gwr in networks.items():
        presented = torch.tensor(config.task_starts) < episode
        tasks = majority_task(match_counts(gwr, bank.seen(), n_tasks) * presented)
        graphs[episode] = (gwr.graph().weights, gwr.graph().edges, tasks)
    path, nodes = run / "train.csv", defaultdict[int, list[int]](list)
    for row in read_rows(path, {"seed": count, "num_nodes": count}):
        nodes[int(row["seed"])].append(int(row["num_nodes"]))
    if nodes.keys() != set(config.seeds):
        raise ValueError(f"{path} does not have the seeds of the run: resume it, or name another")
    figure = plot_gwr_growth(graphs, [nodes[seed] for seed in config.seeds], config.tasks)
    save_figure(figure, (out or run / "figures") / "gwr_growth.png")
    return True
