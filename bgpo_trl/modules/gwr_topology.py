"""The graph of a GWR-B network, and the part of its learning rule that needs no weights."""

from __future__ import annotations

import math
from bisect import bisect_left
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor


@dataclass(frozen=True)
class LearningRule:
    """The constants of GWR-B, explained in `GWRB`.

    Raises:
        ValueError: for a value out of range.
    """

    activity_threshold: float
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
        least_alpha = 1 / self.initial_habituation if self.initial_habituation > 0 else math.inf
        for holds, need in [
            (0 <= self.lr_neighbor <= self.lr_best <= 1, "0 <= lr_neighbor <= lr_best <= 1"),
            (0 < self.initial_habituation <= 1, "0 < initial_habituation <= 1"),
            (self.alpha_best >= least_alpha, "alpha_best >= 1 / initial_habituation"),
            (self.alpha_neighbor >= least_alpha, "alpha_neighbor >= 1 / initial_habituation"),
            (self.tau_best > 0, "tau_best > 0"),
            (self.tau_neighbor > 0, "tau_neighbor > 0"),
            (self.max_age >= 1, "max_age >= 1"),
            (self.max_nodes is None or self.max_nodes >= 2, "max_nodes >= 2, or None"),
        ]:
            if not holds:
                raise ValueError(f"GWR-B needs {need}; got {self}")

    def habituate(self, h: float, alpha: float, tau: float) -> float:
        """Habituation after one more firing (Eqs. 5, 6)."""
        floor = self.initial_habituation - 1 / alpha
        return floor + (h - floor) * math.exp(-alpha / tau)


class BehaviorGraph(NamedTuple):
    """A copy of one network, its nodes in order of creation.

    Attributes:
        weights: `[N, d]`.
        habituation: float64 `[N]`.
        edges: positions (i, j), i < j, of the nodes they join, sorted; int64 `[E, 2]`.
        ages: of the edges, int64 `[E]`.
        node: identities of the nodes, as in `BehaviorMatch.node`; int64 `[N]`, ascending.
    """

    weights: Tensor
    habituation: Tensor
    edges: Tensor
    ages: Tensor
    node: Tensor


class WeightUpdate(NamedTuple):
    """What learning from phi asks of the weights, to be done in this order.

    Attributes:
        insert: whether to append the row (w_c + phi) / 2.
        steps: (row, size): move the weights of that row by `size` of their way to phi.
        delete: rows to delete, one after the other.
    """

    insert: bool
    steps: list[tuple[int, float]]
    delete: list[int]


@dataclass(slots=True)
class Topology:
    """Nodes, edges and habituation of one network; `nodes[i]` has row i of the weights.

    Plain Python on the host: an input touches the few edges of one node, which takes dictionaries
    less time than the call of a single tensor operation. A node is named by its identity: counted
    up from 0, neither reused nor renumbered when a node is removed.
    """

    nodes: list[int] = field(default_factory=list)  # ascending, as they are in order of creation
    habituation: list[float] = field(default_factory=list)  # of each of `nodes`
    neighbors: dict[int, dict[int, int]] = field(default_factory=dict)  # node -> {neighbor: age}
    next_node: int = 0

    @classmethod
    def from_graph(cls, graph: BehaviorGraph, next_node: int) -> Topology:
        """Rebuilds the topology that `to_graph` has copied."""
        nodes = graph.node.tolist()
        topology = cls(nodes, graph.habituation.tolist(), {node: {} for node in nodes}, next_node)
        for (i, j), age in zip(graph.edges.tolist(), graph.ages.tolist(), strict=True):
            topology.connect(nodes[i], nodes[j], age)
        return topology

    def to_graph(self, weights: Tensor) -> BehaviorGraph:
        """Copies the topology to tensors on the device of `weights`, which it goes with."""
        edges = sorted(
            (a, b, age) for a, ages in self.neighbors.items() for b, age in ages.items() if a < b
        )
        table = torch.tensor(edges, dtype=torch.int64, device=weights.device).view(-1, 3)
        node = torch.tensor(self.nodes, dtype=torch.int64, device=weights.device)
        return BehaviorGraph(
            weights=weights,
            habituation=torch.tensor(self.habituation, dtype=torch.float64, device=weights.device),
            edges=torch.searchsorted(node, table[:, :2].contiguous()),
            ages=table[:, 2].clone(),
            node=node,
        )

    def add(self, habituation: float) -> int:
        """Creates a node without edges."""
        node = self.next_node
        self.next_node += 1
        self.nodes.append(node)
        self.habituation.append(habituation)
        self.neighbors[node] = {}
        return node

    def connect(self, a: int, b: int, age: int = 0) -> None:
        """Creates the edge a-b, or sets its age."""
        self.neighbors[a][b] = self.neighbors[b][a] = age

    def disconnect(self, a: int, b: int) -> None:
        """Removes the edge a-b."""
        del self.neighbors[a][b], self.neighbors[b][a]

    def learn(self, best: int, second: int, activity: float, rule: LearningRule) -> WeightUpdate:
        """Takes steps 3 to 5 of `GWRB`, given the rows of the two nearest nodes."""
        c, c_second = self.nodes[best], self.nodes[second]
        self.connect(c, c_second)
        insert = (
            activity < rule.activity_threshold
            and self.habituation[best] < rule.habituation_threshold
            and (rule.max_nodes is None or len(self.nodes) < rule.max_nodes)
        )
        if insert:
            v = self.add(rule.initial_habituation)
            self.connect(v, c)
            self.connect(v, c_second)
            self.disconnect(c, c_second)
        steps = [] if insert else self._fire(c, rule)
        return WeightUpdate(insert, steps, self._age_edges(c, rule.max_age))

    def _fire(self, c: int, rule: LearningRule) -> list[tuple[int, float]]:
        """Habituates c and its neighbors; returns row and step size of each (Eqs. 3-6)."""
        best = (c, rule.lr_best, rule.alpha_best, rule.tau_best)
        others = [
            (k, rule.lr_neighbor, rule.alpha_neighbor, rule.tau_neighbor) for k in self.neighbors[c]
        ]
        steps = []
        for node, lr, alpha, tau in [best, *others]:
            row = self._row(node)
            steps.append((row, lr * self.habituation[row]))
            self.habituation[row] = rule.habituate(self.habituation[row], alpha, tau)
        return steps

    def _age_edges(self, c: int, max_age: int) -> list[int]:
        """Ages the edges of c; those too old go, then nodes without edges; returns the rows."""
        rows = []
        for k, age in list(self.neighbors[c].items()):
            if age < max_age:
                self.connect(c, k, age + 1)
                continue
            self.disconnect(c, k)
            if not self.neighbors[k]:
                row = self._row(k)
                del self.neighbors[k], self.nodes[row], self.habituation[row]
                rows.append(row)
        return rows

    def _row(self, node: int) -> int:
        return bisect_left(self.nodes, node)
