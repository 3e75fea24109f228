"""GWR-B alone: find the clusters of a point cloud, without knowing their number.

python examples/gwr_alone.py
"""

from pathlib import Path

import networkx as nx
import torch
from matplotlib.figure import Figure

from bgpo_trl.configs import GWRBConfig
from bgpo_trl.figures.style import save_figure
from bgpo_trl.modules.gwr import GWRB


def point_cloud(n: int, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Return points ``[n, 2]`` of a ring with a blob inside, and whether each is on the ring."""
    ring = torch.rand(n, generator=generator) < 0.7
    angle = 2 * torch.pi * torch.rand(n, generator=generator)
    circle = torch.stack([angle.cos(), angle.sin()], dim=-1)
    noise = 0.08 * torch.randn(n, 2, generator=generator)
    return torch.where(ring.unsqueeze(-1), circle, 0) + noise, ring


if __name__ == "__main__":
    generator = torch.Generator().manual_seed(0)
    points, ring = point_cloud(4_000, generator)
    # A point farther than -log(0.8) = 0.22 from all nodes adds a node. Clusters separate because
    # an edge is removed once one of its nodes has won 15 times without renewing it.
    gwr = GWRB(2, GWRBConfig(activity_threshold=0.8, max_age=15), init="data")
    for point in points:
        gwr.adapt(point)

    graph = gwr.graph()
    clusters = list(nx.connected_components(graph.to_networkx()))
    cluster_of_node = {node: i for i, nodes in enumerate(clusters) for node in nodes}
    fresh, is_ring = point_cloud(1_000, generator)
    cluster = torch.tensor([cluster_of_node[node] for node in gwr.lookup(fresh).node.tolist()])
    right = sum(int(is_ring[cluster == c].long().bincount().max()) for c in cluster.unique())
    print(f"{len(graph.node)} nodes, {len(graph.edges)} edges, {len(clusters)} clusters")
    print(f"fresh points in the cluster of their own kind: {right / len(fresh):.1%}")

    figure = Figure(figsize=(4, 4), layout="constrained")
    axes = figure.add_subplot(aspect="equal")
    axes.scatter(*points.T, s=2, c="0.8")
    colors = [cluster_of_node[node] for node in graph.node.tolist()]
    for edge in graph.edges:  # pairs of rows of `weights`
        axes.plot(*graph.weights[edge].T, c="0.4", linewidth=0.8)
    axes.scatter(*graph.weights.T, s=14, c=colors, cmap="tab10", zorder=3)
    save_figure(figure, Path("runs/gwr-alone.png"))
    print("figure: runs/gwr-alone.png")
