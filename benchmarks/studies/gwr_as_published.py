"""Grow GWR-B by the demonstrations of the paper's 20,000 episodes, without learning a policy.

What GWR-B learns depends on the demonstrations that are shown, not on the policy. The networks are
therefore those of the runs of the same seeds in docs/protocol.md.

    python benchmarks/studies/gwr_as_published.py benchmarks/results/gwr-paper

Writes ``growth.csv`` (nodes by schedule, scale of the activity, seed and episode), ``networks.csv``
(each network after the last episode) and ``nodes.png`` (Fig. 7: the first seed, all tasks from the
start, scale 1), and prints a table.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import torch
import tyro

from bgpo_trl.algorithms import entry
from bgpo_trl.analysis.statistics import mean
from bgpo_trl.analysis.tables import Table, markdown
from bgpo_trl.analysis.task_inference import majority_task, match_counts, task_inference_accuracy
from bgpo_trl.configs import BGPOConfig
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.encoders.pretrained import load_pretrained
from bgpo_trl.experiments.command_line import command_line
from bgpo_trl.figures.gwr import plot_gwr_pca
from bgpo_trl.figures.style import save_figure
from bgpo_trl.files.writing import make_folder
from bgpo_trl.modules.gwr import GWRB
from bgpo_trl.runs.provenance import write_table
from bgpo_trl.seeding import generators
from bgpo_trl.transforms import DemonstrationSource, TaskSchedule

SCHEDULES = {"from the start": (0, 0, 0), "one after the other": (0, 7_000, 13_000)}
PAIRS = {"distance_1_2": (0, 1), "distance_1_3": (0, 2), "distance_2_3": (1, 2)}


@dataclass(frozen=True)
class Arguments:
    """Demonstrations that GWR-B grows from."""

    out: tyro.conf.Positional[Path]
    """Folder of the results."""
    seeds: tuple[int, ...] = tuple(range(20, 30))
    """Seeds, those of the runs and as many more as make ten."""
    episodes: int = 20_000
    """Demonstrations that each network is shown."""
    every: int = 1_000
    """Episodes between rows of ``growth.csv``."""


def grow(
    bank: DemonstrationBank, starts: tuple[int, ...], scale: float, arguments: Arguments
) -> tuple[GWRB, pd.DataFrame]:
    """Return the networks of all seeds after the last episode, and their nodes on the way."""
    seeds, n_seeds = arguments.seeds, len(arguments.seeds)
    config = entry("bgpo-paper").config
    assert isinstance(config, BGPOConfig)
    size = bank.embedding.shape[-1]
    gwr = GWRB(
        size,
        replace(config.gwr, activity_scale=scale),
        batch_size=[n_seeds],
        generator=generators(seeds, "gwr"),
    )
    source = DemonstrationSource(
        bank,
        TaskSchedule(starts),
        batch_size=[n_seeds],
        generator=generators(seeds, "demonstrations"),
    )
    rows, every_seed = [], torch.ones(n_seeds, dtype=torch.bool)
    for episode in range(1, arguments.episodes + 1):
        source._draw(every_seed)  # without an environment to reset
        gwr.adapt(bank.embedding[source._demo_index])
        source.episode += 1
        if episode % arguments.every == 0:
            nodes = gwr.num_nodes.tolist()
            rows += [(seed, episode, n) for seed, n in zip(seeds, nodes, strict=True)]
    return gwr, pd.DataFrame(rows, columns=pd.Index(["seed", "episode", "nodes"]))


def describe(gwr: GWRB, bank: DemonstrationBank, seeds: tuple[int, ...]) -> pd.DataFrame:
    """Return a row of each network: nodes, task inference, and places of the tasks' nodes."""
    n_tasks, seen = len(bank.tasks), bank.seen()
    task_of_node = majority_task(match_counts(gwr, seen))
    inferred = task_inference_accuracy(gwr, seen, bank.held_out("test"))
    rows = []
    for index, seed in enumerate(seeds):
        weights = gwr.graph(index).weights.numpy().astype(np.float64)
        centered = weights - weights.mean(0)
        points = centered @ np.linalg.svd(centered, full_matrices=False)[2][:2].T
        task = task_of_node[index, : len(points)].numpy()
        of_task = [points[task == number] for number in range(n_tasks)]
        distances = {
            name: np.linalg.norm(of_task[a][:, None] - of_task[b], axis=-1).mean()
            for name, (a, b) in PAIRS.items()
        }
        within = np.mean([np.linalg.norm(own[:, None] - own, axis=-1).mean() for own in of_task])
        rows.append(
            {
                "seed": seed,
                "nodes": len(points),
                "unmatched": int((task < 0).sum()),
                "task_inference": float(inferred[index]),
                **distances,
                "distance_within": within,
            }
        )
    return pd.DataFrame(rows)


@torch.no_grad()
def study(arguments: Arguments) -> str:
    """Grow all networks; write the files and return the table."""
    torch.set_num_threads(1)
    out = make_folder(arguments.out)
    _, bank = load_pretrained()
    growth, networks = [], []
    table: Table = [["order", "scale", "nodes", "task inferred", "1-2", "1-3", "2-3", "within"]]
    for order, starts in SCHEDULES.items():
        for scale in (1.0, BGPOConfig().gwr.activity_scale):
            gwr, nodes = grow(bank.seen(), starts, scale, arguments)
            found = describe(gwr, bank, arguments.seeds)
            for rows, gathered in ((nodes, growth), (found, networks)):
                rows.insert(0, "activity_scale", scale)
                rows.insert(0, "order", order)
                gathered.append(rows)
            of_seeds = mean(found["nodes"])
            interval = f"{of_seeds.value:.0f} [{of_seeds.low:.0f}, {of_seeds.high:.0f}]"
            low, high = found["nodes"].min(), found["nodes"].max()
            shown = [f"{found[name].mean():.2f}" for name in (*PAIRS, "distance_within")]
            table.append(
                [
                    order,
                    f"{scale:g}",
                    f"{interval}, {low} to {high}",
                    f"{found['task_inference'].mean():.1%}",
                    *shown,
                ]
            )
            if scale == 1.0 and not any(starts):
                counts = match_counts(gwr, bank.seen())
                graph = gwr.graph(0)
                task = majority_task(counts)[0, : len(graph.weights)]
                save_figure(plot_gwr_pca(graph.weights, task, bank.tasks), out / "nodes.png")
    write_table(out / "growth.csv", pd.concat(growth))
    write_table(out / "networks.csv", pd.concat(networks).round(4))
    return markdown(table)


if __name__ == "__main__":
    command_line(study)
