"""Groups of behaviors, found without labels by a second, coarser GWR-B over the same embeddings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorClass
from torch import Tensor, nn

from bgpo_trl.errors import as_shape
from bgpo_trl.modules.gwr import GWRB
from bgpo_trl.modules.gwr_topology import read_state

_NEVER = 2**62  # an age that no edge reaches


class GroupMatch(TensorClass["tensor_only"]):
    """Group of each input.

    Attributes:
        group: Number of the group within its network, int64 ``[*batch]``. Groups count up from 0 in
            order of appearance and are never removed or renumbered.
        activity: Activity of the best-matching node in [0, 1], ``[*batch]``; 0 in an empty network.
            Below the activity threshold, the input belongs to no known group.
    """

    group: Tensor
    activity: Tensor


class BehaviorGroups(nn.Module):
    """Groups of similar behaviors, for one network or a batch of independent ones.

    A GWR-B with a low activity threshold inserts few nodes, each far from all earlier ones. Every
    node belongs to a group:

    1. A node inserted for a new input (activity below the threshold) opens a group, whose parent is
       the group of its best match. The node starts half-way between the two and moves towards the
       inputs that it matches.
    2. Any other node, such as the second of two similar first inputs, joins the group of its best
       match.

    Edges do not expire, so groups are kept however long their tasks are absent. The network starts
    empty; until the first input, `lookup` returns group 0.

    Args:
        n_features: Size d of an input.
        batch_size: Shape of the batch (the seeds), or its length; ``()`` is a single set of groups.
        activity_threshold: a_T of the coarse GWR-B, below which an input is new.
        habituation_threshold: h_T, below which a best-matching node allows an insertion. With the
            0.15 of the fine network, tasks that appear together get mixed before any node splits.
        activity_scale: Factor of distances, as in `GWRB`. The defaults fit the embeddings of the
            shipped encoders of three tasks.
        max_groups: Largest number of groups. Once it is reached, a new node joins the group of its
            best match. None: no limit.

    Raises:
        ValueError: If ``max_groups`` is below 1, or an argument of `GWRB` is out of range.

    Example:
        >>> groups = BehaviorGroups(1, activity_threshold=0.5, activity_scale=1.0)
        >>> for x in [0.0, 0.1] * 6 + [3.0] * 2:
        ...     match = groups.adapt(torch.tensor([x]))
        >>> groups.num_groups, groups.lookup(torch.tensor([[0.2], [2.9]])).group
        (tensor(2), tensor([0, 1]))
    """

    def __init__(
        self,
        n_features: int,
        *,
        batch_size: int | Sequence[int] = (),
        activity_threshold: float = 0.525,
        habituation_threshold: float = 0.5,
        activity_scale: float = 0.25,
        max_groups: int | None = None,
    ) -> None:
        super().__init__()
        if max_groups is not None:
            as_shape([max_groups], "max_groups")
        self.gwr = GWRB(
            n_features,
            batch_size=batch_size,
            activity_threshold=activity_threshold,
            habituation_threshold=habituation_threshold,
            activity_scale=activity_scale,
            max_age=_NEVER,
            init="data",
        )
        self.activity_threshold = activity_threshold
        self.max_groups = max_groups
        # By network: the group of each node, and the parent of each group.
        n_networks = self.batch_size.numel()
        self._group: list[list[int]] = [[] for _ in range(n_networks)]
        self._parent: list[list[int]] = [[0] for _ in range(n_networks)]

    @property
    def batch_size(self) -> torch.Size:
        """Shape of the batch of networks."""
        return self.gwr.batch_size

    @property
    def num_groups(self) -> Tensor:
        """Number of groups of each network, at least 1, int64 ``[*batch_size]``."""
        counts = [len(parent) for parent in self._parent]
        return torch.tensor(counts, device=self.gwr.num_nodes.device).view(self.batch_size)

    def parent(self, network: int, group: int) -> int:
        """Return the parent of a group (0 for the first) of a network in the flattened batch."""
        return self._parent[network][group]

    def forward(self, phi: Tensor) -> GroupMatch:
        """Call `lookup`."""
        return self.lookup(phi)

    def lookup(self, phi: Tensor) -> GroupMatch:
        """Return the groups ``[*batch_size, *extra]`` of inputs ``[*batch_size, *extra, d]``.

        Raises:
            ValueError: If phi has the wrong shape or holds NaN or Inf.
        """
        match = self.gwr.lookup(phi, mask=self.gwr.num_nodes > 0)
        n_networks = self.batch_size.numel()
        node = match.node.reshape(n_networks, -1)
        group = torch.zeros_like(node)
        for row, nodes, known in zip(group, node, self._group, strict=True):
            if known:
                row.copy_(torch.tensor(known, device=nodes.device)[nodes])
        return GroupMatch(
            group=group.view(match.node.shape),
            activity=match.activity.nan_to_num(0.0),
            batch_size=match.batch_size,
        )

    def adapt(self, phi: Tensor, mask: Tensor | None = None) -> GroupMatch:
        """Find the group of one input per network and learn from it; see `GWRB.adapt`.

        Returns:
            Matches ``[*batch_size]`` from before learning; -1 and NaN where ``mask`` is False.
        """
        before = self.gwr.num_nodes
        match = self.gwr.adapt(phi, mask)
        grown = (self.gwr.num_nodes > before).flatten().tolist()
        nodes, activity = match.node.flatten().tolist(), match.activity.flatten().tolist()
        matched = []
        for i, (node, grew) in enumerate(zip(nodes, grown, strict=True)):
            of_node, parent = self._group[i], self._parent[i]
            group = -1 if node < 0 else of_node[node] if of_node else 0
            matched.append(group)
            if not grew:
                continue
            full = self.max_groups is not None and len(parent) >= self.max_groups
            if of_node and activity[i] < self.activity_threshold and not full:
                of_node.append(len(parent))
                parent.append(group)
            else:
                of_node.append(group)
        return GroupMatch(
            group=torch.tensor(matched, device=match.node.device).view(self.batch_size),
            activity=match.activity,
            batch_size=self.batch_size,
        )

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *args: Any) -> None:
        # Checked together before either is loaded: nodes and their groups belong together.
        own, gwr = (state_dict.get(f"{prefix}{part}_extra_state") for part in ("", "gwr."))
        if own is not None and gwr is not None:
            _, topologies = read_state(gwr, self.batch_size.numel(), self.gwr.n_features)
            nodes = [topology.next_identity for topology in topologies]
            if [len(numbers) for numbers in own["group"]] != nodes:
                raise ValueError(
                    f"the state has groups of {[len(numbers) for numbers in own['group']]} nodes, "
                    f"but {nodes} nodes: load one that state_dict returned"
                )
        super()._load_from_state_dict(state_dict, prefix, *args)

    def get_extra_state(self) -> dict[str, Any]:
        """Return group and parent numbers, for ``state_dict``."""
        return {
            "group": [list(group) for group in self._group],
            "parent": [list(parent) for parent in self._parent],
        }

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore the result of `get_extra_state`.

        Raises:
            ValueError: If it is of another number of networks, or a group is missing; nothing has
                changed then.
        """
        group, parent = state["group"], state["parent"]
        n_networks = self.batch_size.numel()
        if not len(group) == len(parent) == n_networks:
            raise ValueError(
                f"the state has groups of {len(group)} networks, this BehaviorGroups "
                f"{n_networks}: build it with the same sizes"
            )
        for numbers, parents in zip(group, parent, strict=True):
            if not {*numbers, *parents} <= set(range(len(parents))):
                raise ValueError(
                    "a group is missing in the state: load one that state_dict returned"
                )
        self._group = [list(numbers) for numbers in group]
        self._parent = [list(numbers) for numbers in parent]
