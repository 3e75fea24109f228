"""What GWR-B hands out: the matches of inputs, and copies of its graph."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from tensordict import TensorClass
from torch import Tensor

if TYPE_CHECKING:
    import networkx as nx


class BehaviorMatch(TensorClass["tensor_only"]):
    """The best-matching node of each input.

    Attributes:
        embedding: weight vector w_c of the node, the behavior b; a copy, `[*batch, d]`.
        node: identity of the node within its network, int64 `[*batch]`. Identities count up from 0
            in order of creation; none is reused or renumbered when a node is removed.
        activity: exp(-activity_scale ||phi - w_c||) in [0, 1] (Eq. 2), `[*batch]`.
    """

    embedding: Tensor
    node: Tensor
    activity: Tensor


class BehaviorGraph(NamedTuple):
    """A copy of one network, its nodes in order of creation.

    Where nodes have been removed, the position of a node in this copy is no longer its identity:
    `graph.weights` goes by position, `match.node` by identity. Edges are given in both.

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

    @property
    def edge_nodes(self) -> Tensor:
        """The edges as identities of the nodes they join, int64 `[E, 2]`, in the same order."""
        return self.node[self.edges]

    def to_networkx(self) -> nx.Graph:
        """Copy the graph for networkx, its nodes named by identity, as in `BehaviorMatch.node`.

        Nodes have `weights` (an array `[d]`) and `habituation`, edges have `age`.

        Raises:
            ImportError: if networkx is not installed.

        Examples:
            >>> from bgpo_trl.modules.gwr import GWRB
            >>> gwr = GWRB(2, init="data")
            >>> for point in ([0, 0], [1, 0], [0.9, 0.1]):
            ...     match = gwr.adapt(point)
            >>> graph = gwr.graph().to_networkx()
            >>> graph.edges(data="age")
            EdgeDataView([(0, 1, 1)])
            >>> sorted(graph[int(match.node)])
            [0]
        """
        try:
            import networkx as nx
        except ImportError:
            raise ImportError(
                "to_networkx needs networkx: pip install 'bgpo_trl[networkx]'"
            ) from None

        graph = nx.Graph()
        weights, habituation = self.weights.cpu().numpy(), self.habituation.tolist()
        for i, node in enumerate(self.node.tolist()):
            graph.add_node(node, weights=weights[i].copy(), habituation=habituation[i])
        for (a, b), age in zip(self.edge_nodes.tolist(), self.ages.tolist(), strict=True):
            graph.add_edge(a, b, age=age)
        return graph
