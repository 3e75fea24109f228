"""Nodes and edges of a GWR-B network: the part of its learning rule that needs no weights."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from functools import cached_property
from itertools import product
from numbers import Integral, Real
from typing import Any, NamedTuple

import torch
from torch import Tensor

from bgpo_trl.modules.gwr_graph import BehaviorGraph

_DAMAGED = "the state is damaged or not a graph of GWR-B: load one that state_dict returned"
# Of the tensors of a graph: number of dimensions, and whether they are int64.
_ENTRIES = {
    "weights": (2, False),
    "habituation": (1, False),
    "edges": (2, True),
    "ages": (1, True),
    "node": (1, True),
}


class Firing(NamedTuple):
    """Effect of firing on a node of habituation h.

    The node moves by a fraction ``lr * h`` of its way to the input, then habituates: ``h <- floor +
    (h - floor) * decay``, ``floor = h_0 - 1 / alpha``, ``decay = exp(-alpha / tau)``.
    """

    lr: float
    floor: float
    decay: float


@dataclass(frozen=True)
class LearningRule:
    """Constants of GWR-B, as in `GWRB`; those out of range raise ``ValueError``."""

    activity_threshold: float
    activity_scale: float
    habituation_threshold: float
    lr_best: float
    lr_neighbor: float
    initial_habituation: float
    alpha_best: float
    alpha_neighbor: float
    tau_best: float
    tau_neighbor: float
    max_age: int
    max_nodes: int | None

    def __post_init__(self) -> None:
        constants = asdict(self)
        for name, value in constants.items():
            if not isinstance(value, Real) and (name, value) != ("max_nodes", None):
                raise ValueError(f"{name} must be a number; got {value!r}")
        if not isinstance(self.max_nodes, Integral | None):
            raise ValueError(f"max_nodes must be a whole number, or None; got {self.max_nodes!r}")
        least_alpha = 1 / self.initial_habituation if self.initial_habituation > 0 else math.inf
        for holds, need in [
            (0 <= self.activity_threshold <= 1, "0 <= activity_threshold <= 1"),
            (0 < self.activity_scale < math.inf, "activity_scale > 0"),
            (0 <= self.habituation_threshold < math.inf, "habituation_threshold >= 0"),
            (0 <= self.lr_neighbor <= self.lr_best <= 1, "0 <= lr_neighbor <= lr_best <= 1"),
            (0 < self.initial_habituation <= 1, "0 < initial_habituation <= 1"),
            (least_alpha <= self.alpha_best < math.inf, "alpha_best >= 1 / initial_habituation"),
            (
                least_alpha <= self.alpha_neighbor < math.inf,
                "alpha_neighbor >= 1 / initial_habituation",
            ),
            (0 < self.tau_best < math.inf, "tau_best > 0"),
            (0 < self.tau_neighbor < math.inf, "tau_neighbor > 0"),
            (self.max_age >= 1, "max_age >= 1"),
            (self.max_nodes is None or self.max_nodes >= 2, "max_nodes >= 2, or None"),
        ]:
            if not holds:
                got = ", ".join(f"{x}={constants[x]}" for x in constants if x in need)
                raise ValueError(f"GWR-B needs {need}; got {got}")

    @cached_property
    def best(self) -> Firing:
        """Effect of firing on the best match (Eqs. 3, 5)."""
        floor = self.initial_habituation - 1 / self.alpha_best
        return Firing(self.lr_best, floor, math.exp(-self.alpha_best / self.tau_best))

    @cached_property
    def neighbor(self) -> Firing:
        """Effect of firing on its neighbors (Eqs. 4, 6)."""
        floor = self.initial_habituation - 1 / self.alpha_neighbor
        return Firing(self.lr_neighbor, floor, math.exp(-self.alpha_neighbor / self.tau_neighbor))


class WeightUpdate(NamedTuple):
    """Changes of the weights by which a network learns an input phi, in this order.

    Attributes:
        insert: Whether the next row becomes ``(w_c + phi) / 2``.
        moved: Rows that move towards phi.
        steps: Fraction of the way to phi, for each of ``moved``.
        removed: Rows to erase.
    """

    insert: bool
    moved: list[int]
    steps: list[float]
    removed: list[int]


@dataclass(slots=True)
class Topology:
    """Nodes, edges and habituation of one network; a node is identified by its row of the weights.

    Plain Python on the host: an input changes the few edges of one node, which costs less than a
    single tensor operation. Rows are in order of creation. The row of a removed node stays unused
    until `compact`.
    """

    identity: list[int] = field(default_factory=list)  # by row, ascending
    habituation: list[float] = field(default_factory=list)  # by row
    wins: list[int] = field(default_factory=list)  # by row: times it was the best match
    # Node -> {neighbor: reset}. An edge ages when either end wins, so a-b has age wins[a] + wins[b]
    # - reset, where reset is that sum at age 0. Only reset is stored: a win updates no edge.
    edges: dict[int, dict[int, int]] = field(default_factory=dict)
    next_identity: int = 0

    @classmethod
    def from_graph(cls, graph: BehaviorGraph, next_identity: int) -> Topology:
        """Rebuild the topology of a graph copied by `to_graph`.

        Raises:
            ValueError: If the graph is inconsistent.
        """
        n, ends = len(graph.weights), graph.edges
        sound = (
            len(graph.habituation) == len(graph.node) == n
            and ends.shape == (len(graph.ages), 2)
            and bool(((ends >= 0) & (ends < n)).all() and (ends[:, 0] != ends[:, 1]).all())
            and bool((graph.node.diff() > 0).all() and (graph.node < next_identity).all())
            and bool((graph.ages >= 0).all() and len(ends.sort().values.unique(dim=0)) == len(ends))
            # With alpha = 1 / h_0, habituation decays to 0, or by rounding to just below.
            and bool((graph.habituation >= -1e-9).all() and (graph.habituation <= 1).all())
            and bool(graph.weights.isfinite().all())
        )
        if not sound:
            raise ValueError(_DAMAGED)
        identity, habituation = graph.node.tolist(), graph.habituation.tolist()
        edges = {row: {} for row in range(len(identity))}
        topology = cls(identity, habituation, [0] * len(identity), edges, next_identity)
        for (a, b), age in zip(graph.edges.tolist(), graph.ages.tolist(), strict=True):
            topology.connect(a, b, age)
        return topology

    def to_graph(self, weights: Tensor) -> BehaviorGraph:
        """Copy the network, given the weights of all rows."""
        rows = list(self.edges)
        position = {row: i for i, row in enumerate(rows)}
        edges = sorted(
            (position[a], position[b], self.wins[a] + self.wins[b] - reset)
            for a, resets in self.edges.items()
            for b, reset in resets.items()
            if a < b
        )
        device = weights.device
        table = torch.tensor(edges, dtype=torch.int64, device=device).view(-1, 3)
        habituation = [self.habituation[row] for row in rows]
        identity = [self.identity[row] for row in rows]
        return BehaviorGraph(
            weights=weights[torch.tensor(rows, dtype=torch.int64, device=device)],
            habituation=torch.tensor(habituation, dtype=torch.float64, device=device),
            edges=table[:, :2].clone(),
            ages=table[:, 2].clone(),
            node=torch.tensor(identity, dtype=torch.int64, device=device),
        )

    def is_new(self, rule: LearningRule) -> bool:
        """Return whether the network is two nodes that have not learned from any input."""
        return self.next_identity == 2 and self.habituation == [rule.initial_habituation] * 2

    def compact(self) -> list[int]:
        """Close the gaps left by removed nodes; return the former row of each node."""
        rows = list(self.edges)
        position = {row: i for i, row in enumerate(rows)}
        self.identity = [self.identity[row] for row in rows]
        self.habituation = [self.habituation[row] for row in rows]
        self.wins = [self.wins[row] for row in rows]
        self.edges = {
            position[a]: {position[b]: reset for b, reset in resets.items()}
            for a, resets in self.edges.items()
        }
        return rows

    def add(self, habituation: float) -> int:
        """Create a node without edges; return its row."""
        row = len(self.identity)
        self.identity.append(self.next_identity)
        self.habituation.append(habituation)
        self.wins.append(0)
        self.edges[row] = {}
        self.next_identity += 1
        return row

    def connect(self, a: int, b: int, age: int = 0) -> None:
        """Create the edge a-b, or set its age."""
        self.edges[a][b] = self.edges[b][a] = self.wins[a] + self.wins[b] - age

    def disconnect(self, a: int, b: int) -> None:
        """Remove the edge a-b."""
        del self.edges[a][b], self.edges[b][a]

    def learn(self, c: int, second: int, activity: float, rule: LearningRule) -> WeightUpdate:
        """Take steps 3 to 5 of `GWRB`, given the two nearest nodes."""
        self.connect(c, second)
        insert = (
            activity < rule.activity_threshold
            and self.habituation[c] < rule.habituation_threshold
            and (rule.max_nodes is None or len(self.edges) < rule.max_nodes)
        )
        if insert:
            v = self.add(rule.initial_habituation)
            self.connect(v, c)
            self.connect(v, second)
            self.disconnect(c, second)
        moved = [] if insert else [c, *self.edges[c]]
        steps = self._fire(moved, rule)
        return WeightUpdate(insert, moved, steps, self._age_edges(c, rule.max_age))

    def _fire(self, nodes: list[int], rule: LearningRule) -> list[float]:
        """Habituate nodes, the first as the best match; return each node's step."""
        steps, habituation = [], self.habituation
        lr, floor, decay = rule.best
        for node in nodes:
            h = habituation[node]
            steps.append(lr * h)
            habituation[node] = floor + (h - floor) * decay
            lr, floor, decay = rule.neighbor
        return steps

    def _age_edges(self, c: int, max_age: int) -> list[int]:
        """Age the edges of c, remove expired edges and isolated nodes; return these nodes."""
        wins = self.wins
        wins[c] += 1
        oldest = wins[c] - max_age
        expired = [k for k, reset in self.edges[c].items() if wins[k] + oldest > reset]
        removed = []
        for k in expired:
            self.disconnect(c, k)
            if not self.edges[k]:
                del self.edges[k]
                removed.append(k)
        return removed


def read_state(
    state: list[dict[str, Any]], n_networks: int, n_features: int
) -> tuple[list[BehaviorGraph], list[Topology]]:
    """Read the networks from `GWRB.get_extra_state`.

    Raises:
        ValueError: If they are damaged, or their number or features differ.
    """
    wanted = {*BehaviorGraph._fields, "next_node"}
    if not isinstance(state, list) or not all(
        isinstance(network, dict) and wanted <= network.keys() for network in state
    ):
        raise ValueError(f"the state of a network needs {sorted(wanted)}: see get_extra_state")
    for network, (name, (ndim, whole)) in product(state, _ENTRIES.items()):
        entry = network[name]
        if (
            not isinstance(entry, Tensor)
            or entry.ndim != ndim
            or entry.is_complex()
            or (whole and entry.dtype != torch.int64)
        ):
            raise ValueError(f"{_DAMAGED} ({name})")
    if not all(isinstance(network["next_node"], int) for network in state):
        raise ValueError(f"{_DAMAGED} (next_node)")
    sizes = [network["weights"].shape[1] for network in state]
    if sizes != [n_features] * n_networks:
        raise ValueError(
            f"the state has {len(sizes)} networks of {set(sizes)} features, this GWRB "
            f"{n_networks} of {n_features}: build it with the same sizes"
        )
    graphs = [BehaviorGraph(*(network[x] for x in BehaviorGraph._fields)) for network in state]
    topologies = [
        Topology.from_graph(graph, network["next_node"])
        for graph, network in zip(graphs, state, strict=True)
    ]
    return graphs, topologies
