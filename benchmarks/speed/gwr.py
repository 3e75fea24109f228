"""Cost of GWR-B: time and memory against the number of nodes, and for a batch of networks.

    python benchmarks/speed/gwr.py

prints a table and writes it as ``gwr.json``, and the times against nodes as ``gwr.png``.
"""

from __future__ import annotations

import json
import math
import statistics
import tracemalloc
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure
from timing import Timing, interleave
from torch import Tensor

from bgpo_trl.analysis.tables import markdown
from bgpo_trl.experiments.command_line import command_line
from bgpo_trl.figures.style import save_figure
from bgpo_trl.machine import set_threads
from bgpo_trl.modules.gwr import GWRB

CALLS = ("lookup", "adapt", "lookup + adapt")


@dataclass(frozen=True)
class Arguments:
    """Measure GWR-B."""

    out: Path = Path("runs/speed")
    """Folder of the results."""
    nodes: tuple[int, ...] = (100, 1_000, 10_000, 100_000, 1_000_000)
    """Sizes of a single network."""
    networks: int = 10
    """Networks in the batch."""
    batch_nodes: int = 500
    """Nodes of each network in the batch."""
    features: int = 32
    """Size of an input."""
    rounds: int = 30
    """Timing rounds."""
    threads: int = 1
    """Threads of PyTorch."""


def synthetic_network(n_nodes: int, n_features: int, seed: int) -> dict[str, Any]:
    """Return the state of a network along a curve, with each node joined to the next three."""
    generator = torch.Generator().manual_seed(seed)
    frequency, phase = torch.rand(2, n_features, generator=generator)
    node = torch.arange(n_nodes)
    pairs = torch.cat([torch.stack([node[:-k], node[k:]], -1) for k in (1, 2, 3)])
    return {
        "weights": (node.unsqueeze(-1) * frequency / 10 + 2 * math.pi * phase).sin(),
        "habituation": torch.full((n_nodes,), 0.5, dtype=torch.float64),
        "edges": pairs,
        "ages": torch.zeros(len(pairs), dtype=torch.int64),
        "node": node,
        "next_node": n_nodes,
    }


def make_gwr(n_networks: int, n_nodes: int, n_features: int) -> tuple[GWRB, Tensor, int]:
    """Return full networks, their weights ``[S, N, d]``, and their size in bytes."""
    gwr = GWRB(n_features, batch_size=[n_networks], max_nodes=n_nodes)
    state = [synthetic_network(n_nodes, n_features, seed) for seed in range(n_networks)]
    # tracemalloc sees the graph, which Python allocates, but not the tensors, added below.
    tracemalloc.start()
    gwr.load_state_dict({"_extra_state": state})
    held = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    held += sum(buffer.nbytes for buffer in gwr.buffers())
    return gwr, torch.stack([network["weights"] for network in state]), held


def calls_per_round(gwr: GWRB, weights: Tensor, n_inputs: int) -> dict[str, Callable[[], object]]:
    """Return the calls to time, each of which processes ``n_inputs`` inputs in turn."""
    generator = torch.Generator().manual_seed(0)
    n_networks, n_nodes, n_features = weights.shape
    row = torch.randint(n_nodes, (n_inputs, n_networks), generator=generator)
    noise = torch.randn(n_inputs, n_networks, n_features, generator=generator)
    fixed = weights[torch.arange(n_networks), row] + 0.02 * noise

    def of_all(*methods: Callable[[Tensor], object]) -> Callable[[], None]:
        def call() -> None:
            for phi in fixed:
                for method in methods:
                    method(phi)

        return call

    methods = (gwr.lookup,), (gwr.adapt,), (gwr.lookup, gwr.adapt), (lambda _: weights.sum(),)
    return {name: of_all(*some) for name, some in zip((*CALLS, "read"), methods, strict=True)}


def measure(n_networks: int, n_nodes: int, arguments: Arguments) -> dict[str, Any]:
    """Return times (ms per network) and memory (bytes per node) of a batch of networks."""
    gwr, weights, held = make_gwr(n_networks, n_nodes, arguments.features)
    # Several inputs, so that a call takes milliseconds; fewer for large networks, to save time.
    n_inputs = max(1, min(20, 200_000 // (n_networks * n_nodes)))
    times = interleave(calls_per_round(gwr, weights, n_inputs), rounds=arguments.rounds)
    scale = 1e3 / (n_inputs * n_networks)
    return {
        "networks": n_networks,
        "nodes": n_nodes,
        "bytes_per_node": held / (n_networks * n_nodes),
        **{
            name: asdict(Timing.of([scale * t for t in seconds])) for name, seconds in times.items()
        },
    }


def slope(rows: list[dict[str, Any]], call: str) -> float:
    """Return the exponent of time in nodes, the slope of a regression line in log-log scale."""
    x = [math.log(row["nodes"]) for row in rows]
    y = [math.log(row[call]["median"]) for row in rows]
    return statistics.linear_regression(x, y).slope


def table(rows: list[dict[str, Any]]) -> str:
    """Format the measurements in Markdown."""
    cells = [["networks", "nodes", *CALLS, "read weights", "bytes a node"]]
    for row in rows:
        times = [
            "{median:.4f} ({low:.4f} to {high:.4f})".format(**row[x]) for x in (*CALLS, "read")
        ]
        count = [str(row["networks"]), f"{row['nodes']:,}"]
        cells.append([*count, *times, f"{row['bytes_per_node']:.0f}"])
    return markdown(cells)


def plot(rows: list[dict[str, Any]]) -> Figure:
    """Plot times against nodes of a single network, as medians and quartiles."""
    figure = Figure(figsize=(4.8, 3.6), layout="constrained")
    axes = figure.add_subplot()
    nodes = [row["nodes"] for row in rows]
    for call, style in (("lookup", "o-"), ("adapt", "s--"), ("read", "^:")):
        median, low, high = ([row[call][x] for row in rows] for x in ("median", "low", "high"))
        (line,) = axes.loglog(
            nodes, median, style, label="read weights" if call == "read" else call
        )
        axes.fill_between(nodes, low, high, color=line.get_color(), alpha=0.2, linewidth=0)
    axes.set(xlabel="Nodes", ylabel="Time of a call (ms)")
    axes.grid(color="0.9")
    axes.legend(frameon=False)
    return figure


def main(arguments: Arguments) -> None:
    """Measure the cost of GWR-B against its nodes; print and write the results."""
    if len({*arguments.nodes}) < 2 or min(arguments.nodes) < 2:
        raise ValueError(f"--nodes must be two sizes or more, of at least 2, got {arguments.nodes}")
    for name in ("features", "networks", "rounds"):
        if getattr(arguments, name) < 1:
            raise ValueError(f"--{name} must be at least 1, got {getattr(arguments, name)}")
    set_threads(arguments.threads)
    single = [measure(1, n, arguments) for n in arguments.nodes]
    batch = measure(arguments.networks, arguments.batch_nodes, arguments)
    large = [row for row in single if row["nodes"] >= 10_000]
    fitted = large if len(large) > 1 else single
    exponents = {call: slope(fitted, call) for call in ("lookup", "adapt", "read")}
    result = {
        "unit": "ms a network",
        "features": arguments.features,
        "threads": arguments.threads,
        "rounds": arguments.rounds,
        "torch": torch.__version__,
        "single": single,
        "batch": batch,
        "exponent": {"from": fitted[0]["nodes"], "to": fitted[-1]["nodes"], **exponents},
    }
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "gwr.json").write_text(json.dumps(result, indent=2) + "\n")
    save_figure(plot(single), arguments.out / "gwr.png")
    print("Milliseconds a network, medians and quartiles\n")
    print(table([*single, batch]))
    shown = ", ".join(f"{call} {value:.2f}" for call, value in exponents.items())
    print(f"\nexponent from {fitted[0]['nodes']:,} to {fitted[-1]['nodes']:,} nodes: {shown}")


if __name__ == "__main__":
    command_line(main)
