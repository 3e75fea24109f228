"""Results of GWR-B: matches of inputs, and copies of its graph."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from tensordict import TensorClass
from torch import Tensor

if TYPE_CHECKING:
    import networkx as nx


class BehaviorMatch(TensorClass["tensor_only"]):
    """Best-matching node of each input.

    Attributes:
        embedding: Copy of the node's weights w_c, the behavior b, ``[*batch, d]``.
        node: Identity of the node within its network, int64 ``[*batch]``. Identities count up from
            0 in order of creation and are never reused or renumbered.
        activity: ``exp(-activity_scale ||phi - w_c||)`` in [0, 1] (Eq. 2), ``[*batch]``.
    """

    embedding: Tensor
    node: Tensor
    activity: Tensor


class BehaviorGraph(NamedTuple):
    """A copy of one network, its nodes in order of creation.

    Once nodes have been removed, a node's position in this copy differs from its identity.

    Attributes:
        weights: By position, ``[N, d]``.
        habituation: By position, float64 ``[N]``.
        edges: Positions (i, j), i < j, of the connected nodes, sorted; int64 ``[E, 2]``.
        ages: Ages of the edges, int64 ``[E]``.
        node: Identities, as in `BehaviorMatch`, ascending; int64 ``[N]``.
    """

    weights: Tensor
    habituation: Tensor
    edges: Tensor
    ages: Tensor
    node: Tensor

    @property
    def edge_nodes(self) -> Tensor:
        """The edges as pairs of identities, int64 ``[E, 2]``, in the same order."""
        return self.node[self.edges]

    def to_networkx(self) -> nx.Graph:
        """Return the graph for networkx, its nodes named by identity.

        Nodes have ``weights`` (array ``[d]``) and ``habituation``, edges have ``age``.

        Raises:
            ImportError: If networkx is not installed.

        Example:
            >>> from bgpo_trl.modules.gwr import GWRB
            >>> gwr = GWRB(2, init="data")
            >>> for point in ([0, 0], [1, 0], [0.9, 0.1]):
            ...     match = gwr.adapt(point)
            >>> gwr.graph().to_networkx().edges(data="age")
            EdgeDataView([(0, 1, 1)])
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
