"""GWR-B: the self-organizing network whose nodes are behavior embeddings (paper, Sec. III-B)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from torch import Tensor, nn

from bgpo_trl.errors import as_shape
from bgpo_trl.modules.gwr_graph import BehaviorGraph, BehaviorMatch
from bgpo_trl.modules.gwr_learning import learn, random_nodes, start, with_room
from bgpo_trl.modules.gwr_tensors import (
    Numbers,
    as_generators,
    as_mask,
    as_tensor,
    checked,
    pairwise_distances,
    scattered,
    to_tensor,
)
from bgpo_trl.modules.gwr_topology import LearningRule, Topology, read_state


class GWRB(nn.Module):
    """Grow-When-Required network of behaviors (GWR-B), or a batch of independent ones.

    It learns from one input phi (an embedded demonstration) at a time:

    1. A network starts as two connected nodes with random weights, or as its first two inputs.
    2. Among all nodes, c and c' are the nearest and second nearest to phi (Eq. 1; the older wins a
       tie). The activity is a = exp(-s ||phi - w_c||) (Eq. 2, where s = 1).
    3. The edge c-c' is created, or its age set to 0.
    4. If a < a_T and h_c < h_T, a node v with w_v = (w_c + phi) / 2 and h_v = h_0 is inserted:
       edges v-c and v-c' replace c-c'. Otherwise c and its neighbors k learn by Eqs. 3 and 4,
       w_c += eps_c h_c (phi - w_c) and w_k += eps_n h_k (phi - w_k), and habituate by Eqs. 5 and 6,
       h <- h_inf + (h - h_inf) exp(-alpha / tau) with h_inf = h_0 - 1 / alpha. (There, i is read as
       the node's own firing count: the global iteration would soon habituate all nodes.)
    5. All edges of c age by 1. Edges older than kappa are removed, then nodes without edges.

    Time and memory are linear in nodes and edges. ``state_dict`` holds networks of any size.
    Defaults: Table 1 of Hafez & Wermter, "Behavior Self-Organization Supports Task Inference for
    Continual Robot Learning", 2021.

    Args:
        n_features: Size d of an input.
        batch_size: Shape of the batch of networks (the seeds), or their number; ``()`` is one
            network.
        activity_threshold: a_T.
        activity_scale: s > 0, the factor of distances in the activity. Inputs and random weights
            multiplied by s have the same effect.
        habituation_threshold: h_T.
        lr_best: eps_c, at most 1.
        lr_neighbor: eps_n, at most eps_c.
        initial_habituation: h_0, in (0, 1].
        alpha_best: alpha of c, at least 1 / h_0, so that h stays positive.
        alpha_neighbor: alpha of the neighbors, at least 1 / h_0.
        tau_best: tau of c; the larger, the slower it habituates.
        tau_neighbor: tau of the neighbors.
        max_age: kappa, at least 1.
        max_nodes: Largest number of nodes; a full network adapts its nodes instead of inserting
            one. None: no limit.
        init: ``"random"`` draws both weights uniformly from (-1, 1), the range of an LSTM's hidden
            state. ``"data"`` starts empty: the first input becomes a node and matches it; the
            second becomes another, with an edge of age 0; learning starts with the third.
        generator: Source of the random weights, or one source per network, which then starts as it
            would alone; None: torch's default generator.

    Raises:
        ValueError: If an argument is out of range.

    Example:
        >>> gwr = GWRB(2, batch_size=[3], init="data")
        >>> phi = torch.tensor([[0.0, 0.0], [0.5, 0.0], [0.0, 0.5]])
        >>> gwr.adapt(phi).activity
        tensor([1., 1., 1.])
        >>> gwr.adapt(-phi, mask=torch.tensor([False, False, True])).node
        tensor([-1, -1,  0])
        >>> gwr.num_nodes
        tensor([1, 1, 2])
        >>> gwr.lookup(torch.zeros(3, 100, 2)).shape
        torch.Size([3, 100])
    """

    _weights: Tensor  # [networks, capacity, d]; spare rows are inf, hence never the nearest
    _network: Tensor  # index of each network, 0, 1, ...

    def __init__(
        self,
        n_features: int,
        *,
        batch_size: int | Sequence[int] = (),
        activity_threshold: float = 0.8,
        activity_scale: float = 1.0,
        habituation_threshold: float = 0.15,
        lr_best: float = 0.1,
        lr_neighbor: float = 0.01,
        initial_habituation: float = 1.0,
        alpha_best: float = 1.05,
        alpha_neighbor: float = 1.05,
        tau_best: float = 3.3,
        tau_neighbor: float = 14.3,
        max_age: int = 80,
        max_nodes: int | None = None,
        init: Literal["random", "data"] = "random",
        generator: torch.Generator | Sequence[torch.Generator] | None = None,
    ) -> None:
        super().__init__()
        (self.n_features,) = as_shape([n_features], "n_features")
        self.batch_size = as_shape(batch_size, "batch_size")
        self.rule = LearningRule(
            activity_threshold=activity_threshold,
            activity_scale=activity_scale,
            habituation_threshold=habituation_threshold,
            lr_best=lr_best,
            lr_neighbor=lr_neighbor,
            initial_habituation=initial_habituation,
            alpha_best=alpha_best,
            alpha_neighbor=alpha_neighbor,
            tau_best=tau_best,
            tau_neighbor=tau_neighbor,
            max_age=max_age,
            max_nodes=max_nodes,
        )
        networks = self.batch_size.numel()
        if init not in ("random", "data"):
            raise ValueError(f"init must be 'random' or 'data'; got {init!r}")
        generators = as_generators(generator, networks)

        self._topologies = [Topology() for _ in range(networks)]
        spare = torch.full((networks, 16, self.n_features), torch.inf)
        self.register_buffer("_weights", spare, persistent=False)
        self.register_buffer("_network", torch.arange(networks), persistent=False)
        self.init = init
        if init == "random":
            for i, source in enumerate(generators):
                for node in random_nodes(self.n_features, source):
                    start(self._weights[i], self._topologies[i], node, self.rule)

    def redraw(self, generator: torch.Generator | Sequence[torch.Generator] | None = None) -> None:
        """Draw random weights as on construction, in networks that have not learned yet."""
        for i, source in enumerate(as_generators(generator, len(self._topologies))):
            if self.init == "random" and self._topologies[i].is_new(self.rule):
                self._weights[i, :2] = random_nodes(self.n_features, source).to(self._weights)

    @property
    def num_nodes(self) -> Tensor:
        """Number of nodes of each network, int64 ``[*batch_size]``."""
        counts = [len(topology.edges) for topology in self._topologies]
        return torch.tensor(counts, device=self._weights.device).view(self.batch_size)

    def graph(self, index: int | tuple[int, ...] = ()) -> BehaviorGraph:
        """Copy the network at an index of the batch.

        Raises:
            IndexError: If ``index`` does not select a single network.
        """
        try:
            network = int(torch.arange(len(self._topologies)).view(self.batch_size)[index])
        except (IndexError, RuntimeError, ValueError):
            raise IndexError(
                f"index must name one network of batch_size {[*self.batch_size]}; got {index}"
            ) from None
        return self._topologies[network].to_graph(self._weights[network])

    def extra_repr(self) -> str:
        """Return sizes and thresholds, for ``repr``."""
        nodes = self.num_nodes.flatten()
        sizes = " to ".join(dict.fromkeys(str(int(n)) for n in nodes.aminmax()))
        thresholds = ("activity_threshold", "activity_scale", "habituation_threshold")
        parts = {"batch_size": [*self.batch_size], "num_nodes": sizes}
        parts |= {name: getattr(self.rule, name) for name in thresholds}
        return ", ".join([f"{self.n_features}", *(f"{key}={x}" for key, x in parts.items())])

    def forward(self, phi: Numbers) -> BehaviorMatch:
        """Call `lookup`."""
        return self.lookup(phi)

    def lookup(self, phi: Numbers, mask: Numbers | None = None) -> BehaviorMatch:
        """Find the best match of each input (step 2), without learning.

        Args:
            phi: Numbers ``[*batch_size, *extra, d]``; each network matches all its ``extra``
                inputs.
            mask: Networks that take part, bool ``[*batch_size]``; None: all.

        Returns:
            Matches ``[*batch_size, *extra]``; NaN and node -1 where ``mask`` is False.

        Raises:
            ValueError: If phi has the wrong shape or holds NaN or Inf, or a network is still empty.
        """
        phi = as_tensor(phi, "phi")
        batch, networks, weights = phi.shape[:-1], len(self._topologies), self._weights
        if (*batch[: len(self.batch_size)], *phi.shape[-1:]) != (*self.batch_size, self.n_features):
            raise ValueError(
                f"phi must begin with dimensions {[*self.batch_size]} and end with "
                f"{self.n_features}; got {[*phi.shape]}"
            )
        mask = None if mask is None else as_mask(mask, self.batch_size).to(weights.device)
        network = self._network if mask is None else self._network[mask.flatten()]
        topologies = [self._topologies[i] for i in network.tolist()]
        if not all(topology.edges for topology in topologies):
            raise ValueError("an empty network matches nothing: adapt() it to an input first")
        phi = phi.reshape(networks, batch.numel() // networks, self.n_features)
        if mask is not None:
            phi, weights = phi.to(weights.device)[mask.flatten()], weights[network]
        distance, row = pairwise_distances(checked(phi, weights), weights).min(-1)
        node = [
            [topology.identity[i] for i in rows]
            for topology, rows in zip(topologies, row.tolist(), strict=True)
        ]
        embedding = self._weights[network.unsqueeze(-1), row]
        node = to_tensor(node, row.dtype, row.device).view(row.shape)
        activity = self._activity(distance)
        if mask is not None:
            results, n_networks = (embedding, node, activity), len(self._topologies)
            embedding, node, activity = scattered(results, network, n_networks)
        return BehaviorMatch(
            embedding=embedding.view(*batch, self.n_features),
            node=node.view(batch),
            activity=activity.view(batch),
            batch_size=batch,
        )

    @torch.inference_mode(False)  # networks that grow there could not be changed outside
    def adapt(self, phi: Numbers, mask: Numbers | None = None) -> BehaviorMatch:
        """Find the best match of one input per network and learn from it (steps 2 to 5).

        Args:
            phi: Numbers ``[*batch_size, d]``.
            mask: Networks that take part, bool ``[*batch_size]``; None: all. The others do not
                change, and their phi is ignored.

        Returns:
            Matches ``[*batch_size]`` from before learning; NaN and node -1 where ``mask`` is False.

        Raises:
            ValueError: If phi or mask has the wrong shape, or phi holds NaN or Inf for a network
                that takes part; no network has changed then.
        """
        phi = as_tensor(phi, "phi")
        if phi.shape != (*self.batch_size, self.n_features):
            raise ValueError(
                f"phi must be {[*self.batch_size, self.n_features]}; got {[*phi.shape]}"
            )
        phi, network = phi.reshape(-1, self.n_features), self._network
        if mask is not None:
            mask = as_mask(mask, self.batch_size).to(network.device).flatten()
            phi, network = phi.to(mask.device)[mask], network[mask]
        phi = checked(phi, self._weights)
        networks = network.tolist()
        self._weights = with_room(self._weights, self._topologies, networks)
        topologies = [self._topologies[i] for i in networks]
        n_before = [len(topology.edges) for topology in topologies]
        for k in [k for k, n in enumerate(n_before) if n == 0]:
            start(self._weights[networks[k]], topologies[k], phi[k], self.rule)

        weights = self._weights
        searched = weights if mask is None else weights[network]
        distances = pairwise_distances(phi.unsqueeze(1), searched).squeeze(1)
        distance, best = distances.min(-1)
        second = distances.scatter_(-1, best.unsqueeze(-1), torch.inf).min(-1).indices
        embedding, activity = weights[network, best], self._activity(distance)
        nearest = list(zip(best.tolist(), second.tolist(), activity.tolist(), strict=True))
        identities = [t.identity[match[0]] for t, match in zip(topologies, nearest, strict=True)]
        node = to_tensor(identities, best.dtype, best.device)
        learn(weights, self._topologies, self.rule, phi, embedding, networks, n_before, nearest)

        if mask is not None:
            results, n_networks = (embedding, node, activity), len(self._topologies)
            embedding, node, activity = scattered(results, network, n_networks)
        batch = self.batch_size
        return BehaviorMatch(
            embedding.view(*batch, -1), node.view(batch), activity.view(batch), batch_size=batch
        )

    def get_extra_state(self) -> list[dict[str, Any]]:
        """Return each network's `graph` and next identity, for ``state_dict``."""
        return [
            {**topology.to_graph(weights)._asdict(), "next_node": topology.next_identity}
            for topology, weights in zip(self._topologies, self._weights, strict=True)
        ]

    def set_extra_state(self, state: list[dict[str, Any]]) -> None:
        """Replace the networks by those of `get_extra_state`.

        Raises:
            ValueError: If they are damaged, or their number or features differ; nothing has changed
                then.
        """
        graphs, topologies = read_state(state, len(self._topologies), self.n_features)
        capacity = max(2, *(len(graph.node) for graph in graphs))
        weights = self._weights.new_full((len(graphs), capacity, self.n_features), torch.inf)
        for rows, graph in zip(weights, graphs, strict=True):
            rows[: len(graph.node)] = graph.weights
        self._topologies, self._weights = topologies, weights

    def _activity(self, distance: Tensor) -> Tensor:
        """Convert distances into activities, in place (Eq. 2)."""
        return distance.mul_(-self.rule.activity_scale).exp_()
