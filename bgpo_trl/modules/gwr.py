"""GWR-B: the self-organizing network whose nodes are behavior embeddings (paper, Sec. III-B).

It is the Grow-When-Required network of Marsland, Shapiro and Nehmzow, "A self-organising network
that grows when required", 2002.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from reprlib import repr as short_repr
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Self, TypeAlias

import numpy as np
import numpy.typing as npt
import torch
from tensordict import TensorClass
from torch import Tensor, nn

from bgpo_trl.configs import GWRBConfig
from bgpo_trl.errors import as_shape
from bgpo_trl.seeding import one_each

if TYPE_CHECKING:
    import networkx as nx

Numbers: TypeAlias = Tensor | npt.ArrayLike


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

        Examples:
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

    Args:
        n_features: Size d of an input.
        config: The constants; None: those of the paper's Table 1.
        batch_size: Shape of the batch of networks (the seeds), or their number; ``()`` is one
            network.
        max_nodes: Largest number of nodes, at least 2; a full network adapts its nodes instead of
            inserting one. None: no limit.
        init: ``"random"`` draws both weights uniformly from (-1, 1), the range of an LSTM's hidden
            state. ``"data"`` starts empty: the first input becomes a node and matches it; the
            second becomes another, with an edge of age 0; learning starts with the third.
        generator: Source of the random weights, or one source per network, which then starts as it
            would alone; None: torch's default generator.

    Raises:
        ValueError: If an argument is out of range.

    Examples:
        >>> gwr = GWRB(2, GWRBConfig(max_age=15), batch_size=[3], init="data")
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

    # Rows of nodes in order of creation, followed by spare ones, whose weights are infinite and
    # hence never the nearest. The row of a removed node is a spare one, too, until `_make_room`.
    _weights: Tensor  # [networks, capacity, d]
    _identity: Tensor  # [networks, capacity]

    def __init__(
        self,
        n_features: int,
        config: GWRBConfig | None = None,
        *,
        batch_size: int | Sequence[int] = (),
        max_nodes: int | None = None,
        init: Literal["random", "data"] = "random",
        generator: torch.Generator | Sequence[torch.Generator] | None = None,
    ) -> None:
        super().__init__()
        (self.n_features,) = as_shape([n_features], "n_features")
        self.batch_size = as_shape(batch_size, "batch_size")
        self.config = config or GWRBConfig()
        if max_nodes is not None and not (max_nodes >= 2 and max_nodes == int(max_nodes)):
            raise ValueError(
                f"max_nodes must be at least 2, a whole number, or None; got {max_nodes}"
            )
        if init not in ("random", "data"):
            raise ValueError(f"init must be 'random' or 'data'; got {init!r}")
        self.max_nodes, self.init = max_nodes, init
        n_networks = self.batch_size.numel()
        self._topologies = [_Topology(self.config.initial_habituation) for _ in range(n_networks)]
        weights = torch.full((n_networks, 16, self.n_features), torch.inf)
        self.register_buffer("_weights", weights, persistent=False)
        identity = torch.full((n_networks, 16), -1)
        self.register_buffer("_identity", identity, persistent=False)
        if init == "random":
            for network, topology in enumerate(self._topologies):
                for row in weights.new_zeros(2, self.n_features):
                    self._insert(network, row)
                topology.connect(0, 1)
        self.redraw(generator)

    def redraw(self, generator: torch.Generator | Sequence[torch.Generator] | None = None) -> None:
        """Draw random weights as on construction, in networks that have not learned yet."""
        start = [self.config.initial_habituation] * 2
        for network, source in enumerate(one_each(generator, len(self._topologies))):
            topology = self._topologies[network]
            is_new = topology.next_identity == 2 and topology.habituation == start
            if self.init == "random" and is_new:
                device = None if source is None else source.device
                drawn = torch.rand(2, self.n_features, generator=source, device=device)
                self._weights[network, :2] = (2 * drawn - 1).to(self._weights)

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
        return self._graph(network)

    def extra_repr(self) -> str:
        """Return sizes and constants, for ``repr``."""
        sizes = f"batch_size={[*self.batch_size]}, num_nodes={self.num_nodes.tolist()}"
        return f"{self.n_features}, {self.config}, {sizes}"

    def forward(self, phi: Numbers) -> BehaviorMatch:
        """Call `lookup`."""
        return self.lookup(phi)

    def lookup(self, phi: Numbers) -> BehaviorMatch:
        """Find the best match of each input (step 2), without learning.

        Args:
            phi: Numbers ``[*batch_size, *extra, d]``; each network matches all its ``extra``
                inputs.

        Returns:
            Matches ``[*batch_size, *extra]``.

        Raises:
            ValueError: If phi has the wrong shape or holds NaN or Inf, or a network is still empty.
        """
        phi = as_tensor(phi, "phi").to(self._weights.device)
        batch, n_networks = phi.shape[:-1], len(self._topologies)
        if (*batch[: len(self.batch_size)], *phi.shape[-1:]) != (*self.batch_size, self.n_features):
            raise ValueError(
                f"phi must begin with dimensions {[*self.batch_size]} and end with "
                f"{self.n_features}; got {[*phi.shape]}"
            )
        network = self._taking_part(None)
        if not all(topology.edges for topology in self._topologies):
            raise ValueError("an empty network matches nothing: adapt() it to an input first")
        phi = phi.reshape(n_networks, batch.numel() // n_networks, self.n_features)
        phi = checked(phi, self._weights)
        distance, row = self._distances(phi, network).min(-1)
        return self._match(network, row, self._activity(distance), batch)

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
        phi = as_tensor(phi, "phi").to(self._weights.device)
        if phi.shape != (*self.batch_size, self.n_features):
            raise ValueError(
                f"phi must be {[*self.batch_size, self.n_features]}; got {[*phi.shape]}"
            )
        network = self._taking_part(mask)
        phi = checked(self._part(phi.reshape(-1, self.n_features), network), self._weights)
        networks, inputs = network.tolist(), phi.unbind()
        self._make_room(networks)
        n_before = [len(self._topologies[i].edges) for i in networks]
        for i, n_nodes, x in zip(networks, n_before, inputs, strict=True):
            if n_nodes == 0:
                self._insert(i, x)

        distances = self._distances(phi.unsqueeze(1), network).squeeze(1)
        distance, best = distances.min(-1)
        second = distances.scatter_(-1, best.unsqueeze(-1), torch.inf).argmin(-1)
        activity = self._activity(distance)
        match = self._match(network, best, activity, self.batch_size)
        nearest = zip(best.tolist(), second.tolist(), activity.tolist(), strict=True)

        changes: list[_Change] = []
        for i, n_nodes, x, (c, other, a) in zip(networks, n_before, inputs, nearest, strict=True):
            if n_nodes == 1:
                self._topologies[i].connect(0, self._insert(i, x))
            changes.append(_Change() if n_nodes < 2 else self._learn(i, x, c, other, a))
        self._move(networks, phi, changes)
        return match

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Convert the weights, such as for ``to``; refuse types too coarse to learn in."""
        dtype = fn(self._weights.new_zeros(0)).dtype
        if dtype not in (torch.float32, torch.float64):
            raise ValueError(f"GWR-B learns in float32 or float64, not in {dtype}: leave it there")
        return super()._apply(fn, recurse)

    def _taking_part(self, mask: Numbers | None) -> Tensor:
        """Return the indices of the networks that a mask selects, int64 ``[A]``."""
        network = torch.arange(len(self._topologies), device=self._weights.device)
        if mask is None:
            return network
        mask = as_tensor(mask, "mask")
        if mask.shape != self.batch_size or mask.dtype != torch.bool:
            raise ValueError(
                f"mask must be bool {[*self.batch_size]}; got {mask.dtype} {[*mask.shape]}"
            )
        return network[mask.to(network.device).flatten()]

    def _part(self, values: Tensor, network: Tensor) -> Tensor:
        """Return the rows of all networks' values that belong to the given ones."""
        return values if len(network) == len(values) else values[network]

    def _distances(self, phi: Tensor, network: Tensor) -> Tensor:
        """Return the distances ``[A, M, capacity]`` of inputs ``[A, M, d]`` to all nodes."""
        weights = self._part(self._weights, network)
        # The default of cdist, a matrix product, is off by 1e-3 near a distance of 0.
        return torch.cdist(phi, weights, compute_mode="donot_use_mm_for_euclid_dist")

    def _activity(self, distance: Tensor) -> Tensor:
        """Convert distances into activities, in place (Eq. 2)."""
        return distance.mul_(-self.config.activity_scale).exp_()

    def _match(
        self, network: Tensor, row: Tensor, activity: Tensor, batch: torch.Size
    ) -> BehaviorMatch:
        """Return the matches of all networks, given row and activity of some, ``[A, ...]``."""
        n_networks = len(self._topologies)

        def of_all(values: Tensor, fill: float) -> Tensor:
            if len(network) == n_networks:
                return values
            filled = values.new_full((n_networks, *values.shape[1:]), fill)
            return filled.index_copy_(0, network, values)

        index = (network if row.ndim == 1 else network.unsqueeze(-1)), row
        return BehaviorMatch(
            embedding=of_all(self._weights[index], torch.nan).view(*batch, self.n_features),
            node=of_all(self._identity[index], -1).view(batch),
            activity=of_all(activity, torch.nan).view(batch),
            batch_size=batch,
        )

    def _learn(self, network: int, phi: Tensor, c: int, second: int, activity: float) -> _Change:
        """Take steps 3 to 5 in one network, except for the changes of its weights.

        Args:
            network: Index of the network.
            phi: The input ``[d]``.
            c: Row of the best match.
            second: Row of the second best, c'.
            activity: Activity of c.
        """
        topology, constants = self._topologies[network], self.config
        topology.connect(c, second)
        moved: list[int] = []
        steps: list[float] = []
        if (
            activity < constants.activity_threshold
            and topology.habituation[c] < constants.habituation_threshold
            and (self.max_nodes is None or len(topology.edges) < self.max_nodes)
        ):
            v = self._insert(network, (self._weights[network, c] + phi) / 2)
            topology.connect(v, c)
            topology.connect(v, second)
            topology.disconnect(c, second)
        else:
            neighbors = [*topology.edges[c]]
            moved = [c, *neighbors]
            steps = topology.fire([c], constants.lr_best, constants.alpha_best, constants.tau_best)
            steps += topology.fire(
                neighbors, constants.lr_neighbor, constants.alpha_neighbor, constants.tau_neighbor
            )
        return _Change(moved, steps, topology.age_edges(c, constants.max_age))

    def _move(self, networks: list[int], phi: Tensor, changes: list[_Change]) -> None:
        """Change the weights of networks that have learned inputs ``[A, d]``, all at once."""
        capacity, pairs = self._weights.shape[1], [*zip(networks, changes, strict=True)]
        # Rows of the weights of all networks, laid end to end.
        moved = [i * capacity + row for i, change in pairs for row in change.moved]
        removed = [i * capacity + row for i, change in pairs for row in change.removed]
        source = [k for k, change in enumerate(changes) for _ in change.moved]
        steps = [step for change in changes for step in change.steps]
        weights = self._weights.view(-1, self.n_features)
        if moved:
            row, k = (_to_tensor(x, torch.int64, phi.device) for x in (moved, source))
            step = _to_tensor(steps, phi.dtype, phi.device).unsqueeze(-1)
            weights.index_copy_(0, row, weights[row].lerp(phi[k], step))
        if removed:
            weights[removed] = torch.inf

    def _insert(self, network: int, weights: Tensor) -> int:
        """Create a node without edges; return its row."""
        topology = self._topologies[network]
        row = topology.add()
        self._weights[network, row] = weights
        self._identity[network, row] = topology.next_identity - 1
        return row

    def _make_room(self, networks: list[int]) -> None:
        """Provide a spare row in each of the networks.

        A full network first reuses the rows of removed nodes, if these are at least an eighth of
        its rows. Otherwise the capacity grows by an eighth: proportionally, so that growth is
        cheap, but little, since every row is searched.
        """
        capacity = self._weights.shape[1]
        share = max(16, capacity // 8)
        full = [i for i in networks if len(self._topologies[i].habituation) == capacity]
        if any(capacity - len(self._topologies[i].edges) < share for i in full):
            self._weights = nn.functional.pad(self._weights, (0, 0, 0, share), value=torch.inf)
            self._identity = nn.functional.pad(self._identity, (0, share), value=-1)
            return
        for i in full:
            rows = self._topologies[i].compact()
            self._weights[i, : len(rows)] = self._weights[i, rows]
            self._weights[i, len(rows) :] = torch.inf
            self._identity[i, : len(rows)] = self._identity[i, rows]

    def _graph(self, network: int) -> BehaviorGraph:
        """Copy a network, given its index in the flattened batch."""
        topology, device = self._topologies[network], self._weights.device
        row = torch.tensor([*topology.edges], dtype=torch.int64, device=device)
        edges, habituation = topology.sorted_edges(), topology.habituation
        table = torch.tensor(edges, dtype=torch.int64, device=device).view(-1, 3)
        of_nodes = [habituation[row] for row in topology.edges]
        return BehaviorGraph(
            weights=self._weights[network, row],
            habituation=torch.tensor(of_nodes, dtype=torch.float64, device=device),
            edges=table[:, :2].clone(),
            ages=table[:, 2].clone(),
            node=self._identity[network, row],
        )

    def get_extra_state(self) -> list[dict[str, Any]]:
        """Return each network's `graph` and next identity, for ``state_dict``."""
        return [
            {**self._graph(i)._asdict(), "next_node": topology.next_identity}
            for i, topology in enumerate(self._topologies)
        ]

    def set_extra_state(self, state: list[dict[str, Any]]) -> None:
        """Replace the networks by those of `get_extra_state`.

        Raises:
            ValueError: If they are damaged, or their number or features differ; nothing has changed
                then.
        """
        if not isinstance(state, list) or not all(_is_sound(network) for network in state):
            raise ValueError(
                "the state is damaged or not a graph of GWR-B: load one that state_dict returned"
            )
        sizes = [network["weights"].shape[1] for network in state]
        if sizes != [self.n_features] * len(self._topologies):
            raise ValueError(
                f"the state has {len(sizes)} networks of {set(sizes)} features, this GWRB "
                f"{len(self._topologies)} of {self.n_features}: build it with the same sizes"
            )
        capacity = max(2, *(len(network["node"]) for network in state))
        weights = self._weights.new_full((len(state), capacity, self.n_features), torch.inf)
        identity = self._identity.new_full((len(state), capacity), -1)
        for i, network in enumerate(state):
            weights[i, : len(network["node"])] = network["weights"]
            identity[i, : len(network["node"])] = network["node"]
        self._weights, self._identity = weights, identity
        self._topologies = [self._topology(network) for network in state]

    def _topology(self, state: dict[str, Any]) -> _Topology:
        """Rebuild the topology of a network in `get_extra_state`."""
        habituation = state["habituation"].tolist()
        edges = {row: {} for row in range(len(habituation))}
        topology = _Topology(
            self.config.initial_habituation, habituation, edges, state["next_node"]
        )
        for (a, b), age in zip(state["edges"].tolist(), state["ages"].tolist(), strict=True):
            topology.connect(a, b, age)
        return topology


class _Change(NamedTuple):
    """Changes of a network's weights after an input."""

    moved: Sequence[int] = ()  # rows that move towards the input
    steps: Sequence[float] = ()  # the fraction of the way that each of these moves
    removed: Sequence[int] = ()  # rows of removed nodes


@dataclass(slots=True)
class _Topology:
    """Edges and habituation of one network; a node is identified by its row of the weights.

    Plain Python on the host: an input changes the few edges of one node, which costs less than a
    single tensor operation.
    """

    initial_habituation: float
    habituation: list[float] = field(default_factory=list)  # by row, those of removed nodes as well
    edges: dict[int, dict[int, int]] = field(default_factory=dict)  # node -> {neighbor: age}
    next_identity: int = 0

    def sorted_edges(self) -> list[tuple[int, int, int]]:
        """Return the edges (i, j, age), i < j, by position among the nodes."""
        position = {row: i for i, row in enumerate(self.edges)}
        return sorted(
            (position[a], position[b], age)
            for a, neighbors in self.edges.items()
            for b, age in neighbors.items()
            if a < b
        )

    def add(self) -> int:
        """Create a node without edges; return its row."""
        row = len(self.habituation)
        self.habituation.append(self.initial_habituation)
        self.edges[row] = {}
        self.next_identity += 1
        return row

    def connect(self, a: int, b: int, age: int = 0) -> None:
        """Create the edge a-b, or set its age."""
        self.edges[a][b] = self.edges[b][a] = age

    def disconnect(self, a: int, b: int) -> None:
        """Remove the edge a-b."""
        del self.edges[a][b], self.edges[b][a]

    def fire(self, nodes: list[int], lr: float, alpha: float, tau: float) -> list[float]:
        """Habituate nodes that fire (Eqs. 5 and 6); return their steps (Eqs. 3 and 4).

        A step is the fraction ``lr * h`` of the way to the input, with h from before.
        """
        steps = []
        h_inf, decay = self.initial_habituation - 1 / alpha, math.exp(-alpha / tau)
        for node in nodes:
            h = self.habituation[node]
            steps.append(lr * h)
            self.habituation[node] = h_inf + (h - h_inf) * decay
        return steps

    def age_edges(self, c: int, max_age: int) -> list[int]:
        """Age the edges of c, remove expired edges and isolated nodes; return these nodes."""
        removed, edges = [], self.edges
        for k, age in [*edges[c].items()]:
            edges[c][k] = edges[k][c] = age + 1
            if age >= max_age:
                self.disconnect(c, k)
                if not edges[k]:
                    del edges[k]
                    removed.append(k)
        return removed

    def compact(self) -> list[int]:
        """Close the gaps left by removed nodes; return the former row of each node."""
        rows = list(self.edges)
        position = {row: i for i, row in enumerate(rows)}
        self.habituation = [self.habituation[row] for row in rows]
        self.edges = {
            position[a]: {position[b]: age for b, age in neighbors.items()}
            for a, neighbors in self.edges.items()
        }
        return rows


def _is_sound(network: object) -> bool:
    """Return whether an entry of a state is a graph of GWR-B."""
    if not isinstance(network, dict):
        return False
    entries = [network.get(name) for name in BehaviorGraph._fields]
    tensors = [entry for entry in entries if isinstance(entry, Tensor)]
    next_node = network.get("next_node")
    if len(tensors) < len(entries) or not isinstance(next_node, int):
        return False
    weights, habituation, edges, ages, node = BehaviorGraph(*tensors)
    n = len(weights) if weights.ndim == 2 else -1
    return (
        node.shape == habituation.shape == (n,)
        and edges.shape == (ages.numel(), 2)
        and ages.ndim == 1
        and node.dtype == edges.dtype == ages.dtype == torch.int64
        and weights.is_floating_point()
        and bool(weights.isfinite().all())
        # With alpha = 1 / h_0, habituation decays to 0, or by rounding to just below.
        and bool(((habituation >= -1e-9) & (habituation <= 1)).all())
        and bool(((edges >= 0) & (edges < n)).all() and (edges[:, 0] != edges[:, 1]).all())
        and len(edges.sort().values.unique(dim=0)) == len(edges)
        and bool((ages >= 0).all())
        and bool((node.diff() > 0).all() and (node < next_node).all())
    )


def as_tensor(value: Numbers, name: str) -> Tensor:
    """Return numbers as a tensor of their own dtype; raise ``ValueError`` for anything else."""
    if isinstance(value, Tensor):
        return value
    try:
        # Copied: torch accepts neither negative strides nor read-only memory.
        return torch.from_numpy(np.array(value))
    except (TypeError, ValueError, RuntimeError):
        raise ValueError(
            f"{name} must be a tensor, an array, or lists of equal lengths, of numbers; "
            f"got {short_repr(value)}"
        ) from None


def checked(phi: Tensor, weights: Tensor, name: str = "phi") -> Tensor:
    """Return an input in the dtype and on the device of the weights, without gradient.

    Raises:
        ValueError: If it is complex, not finite, or so large that squared distances overflow.
    """
    if phi.is_complex():
        raise ValueError(f"{name} must be real numbers; got complex ones")
    phi = phi.detach().to(weights)
    # Beyond this limit a squared distance could overflow, making all nodes equally near.
    limit = torch.finfo(phi.dtype).max ** 0.5 / 2
    if not torch.linalg.vector_norm(phi).item() <= limit:
        raise ValueError(f"{name} must be free of NaN, Inf and values beyond +-{limit:.0e}")
    return phi


def _to_tensor(numbers: list[Any], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return a list of numbers as a tensor; by way of NumPy, four times as fast."""
    return torch.as_tensor(np.array(numbers), dtype=dtype, device=device)
