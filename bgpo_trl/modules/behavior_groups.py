"""Groups of behaviors, found without labels as clusters of the demonstrations shown so far."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from tensordict import TensorClass
from torch import Tensor, nn

from bgpo_trl.errors import as_shape
from bgpo_trl.modules.density_clusters import density_clusters, local_whitening
from bgpo_trl.modules.gwr import Numbers, as_mask, as_tensor

_KNOWN_SHARE = 0.99  # of a group's own demonstrations that are to count as known
_ROUNDING = 1e-4  # of a vector's length; shipped demonstrations differ by 600 times as much
_ARRAYS = ("points", "shown", "group", "member", "cluster")  # of the state
_LISTS = ("parent", "links")


class GroupMatch(TensorClass["tensor_only"]):
    """Group of each input.

    Attributes:
        group: Number of the group within its network, int64 ``[*batch]``. Numbers count up from 0
            in order of appearance and are never used again.
        novelty: Distance to the group's demonstrations relative to the group's own extent,
            float32 ``[*batch]``: above 1, the input lies farther out than 99 % of them and belongs
            to no known group. Infinite as long as there are too few demonstrations for a group.
    """

    group: Tensor
    novelty: Tensor

    @property
    def known(self) -> Tensor:
        """Whether inputs belong to a known group, bool ``[*batch]``."""
        return self.novelty <= 1.0


class BehaviorGroups(nn.Module):
    """Groups of similar behaviors, for one network or a batch of independent ones.

    A group is a cluster of the different demonstrations shown so far, separated from the others by
    a valley of significantly lower density (`density_clusters`). No distance is given: the same
    inputs at another scale form the same groups. Distances are measured after `local_whitening`,
    since most features of an embedding vary within each behavior, and those that tell behaviors
    apart may be the small ones.

    1. A demonstration that is shown again, or differs from an earlier one by no more than rounding
       (a ten-thousandth of its length), adds nothing. With every ``smallest`` new ones (beyond
       ``100 * smallest``: with every hundredth part more), all are clustered anew; until the first
       time, all are of group 0.
    2. An input belongs to the group of the nearest clustered demonstration. Its novelty is the
       distance to the group's ``k``-th nearest, ``k = smallest // 2``, divided by the 99 % quantile
       of this distance among the group's own demonstrations.
    3. Groups keep their number when they are clustered anew. Clusters and groups are matched in the
       order of the number of times that the demonstrations they have in common were shown. So, of a
       group that splits, the larger part keeps the number; of groups that merge, the result has
       that of the group played most. A cluster that is left over becomes a new group, whose parent
       is the group with which it has most in common.
    4. Groups that turn out to be one behavior can be joined (`join`), and stay so: the clusters of
       their densest demonstrations are one group from then on.

    Args:
        n_features: Size d of an input.
        batch_size: Shape of the batch (the seeds), or its length; ``()`` is a single set of groups.
        smallest: Least number of different demonstrations of a group.
        evidence: Depth of a significant valley, in multiples of what chance explains.

    Raises:
        ValueError: If ``smallest`` is below 4 or ``evidence`` is not positive.

    Examples:
        >>> groups = BehaviorGroups(3)
        >>> inputs = torch.randn(60, 3, generator=torch.Generator().manual_seed(0))
        >>> inputs[1::2] += 10
        >>> for x in inputs:
        ...     match = groups.adapt(x)
        >>> groups.num_groups, groups.lookup(torch.tensor([[0.0] * 3, [10.0] * 3, [5.0] * 3])).known
        (tensor(2), tensor([ True,  True, False]))
    """

    def __init__(
        self,
        n_features: int,
        *,
        batch_size: int | Sequence[int] = (),
        smallest: int = 10,
        evidence: float = 1.0,
    ) -> None:
        super().__init__()
        (self.n_features,) = as_shape([n_features], "n_features")
        self.batch_size = as_shape(batch_size, "batch_size")
        if not (smallest >= 4 and smallest == int(smallest) and 0 < evidence < np.inf):
            raise ValueError(
                "smallest must be a whole number of at least 4 and evidence positive, got "
                f"{smallest} and {evidence}"
            )
        self.smallest, self.evidence = int(smallest), float(evidence)
        self._networks = [self._network() for _ in range(self.batch_size.numel())]

    @property
    def num_groups(self) -> Tensor:
        """Number of groups of each network now, at least 1, int64 ``[*batch_size]``."""
        return self._per_network([len(network.reach) or 1 for network in self._networks])

    @property
    def revision(self) -> Tensor:
        """How often earlier demonstrations have changed their groups, int64 ``[*batch_size]``."""
        return self._per_network([network.revision for network in self._networks])

    def numbers(self, network: int) -> list[int]:
        """Return the numbers of the groups of a network in the flattened batch, ascending."""
        return sorted(self._networks[network].reach) or [0]

    def parent(self, network: int, group: int) -> int:
        """Return the parent of a group (0 for the first) of a network in the flattened batch."""
        return self._networks[network].parent[group]

    def join(self, network: int, first: int, second: int) -> None:
        """Join two groups of a network in the flattened batch, given their numbers.

        Raises:
            ValueError: If there is no such group, or both are the same.
        """
        missing = {first, second} - {*self.numbers(network)}
        if missing or first == second:
            raise ValueError(
                f"groups to join must be two of {self.numbers(network)}, got {first} and {second}"
            )
        self._networks[network].join(first, second)

    def forward(self, phi: Numbers) -> GroupMatch:
        """Call `lookup`."""
        return self.lookup(phi)

    def lookup(self, phi: Numbers, mask: Numbers | None = None) -> GroupMatch:
        """Return the groups ``[*batch_size, *extra]`` of inputs ``[*batch_size, *extra, d]``.

        Args:
            phi: Inputs.
            mask: Networks that take part, bool ``[*batch_size]``; None: all. The others' groups are
                -1, their novelties NaN.

        Raises:
            ValueError: If phi or mask has the wrong shape, or a phi that takes part holds NaN or
                Inf.
        """
        n_batch, phi = len(self.batch_size), as_tensor(phi, "phi")
        if phi.shape[:n_batch] != self.batch_size or phi.ndim == n_batch:
            raise ValueError(
                f"phi must lead with {[*self.batch_size]}, one for each network, got {[*phi.shape]}"
            )
        inputs, active = self._checked(phi, mask)
        inputs = inputs.reshape(len(active), -1, self.n_features)
        group, novelty = np.full(inputs.shape[:2], -1), np.full(inputs.shape[:2], np.nan)
        for i in np.flatnonzero(active):
            group[i], novelty[i] = self._networks[i].lookup(inputs[i])
        return self._match(group, novelty, phi)

    def adapt(self, phi: Numbers, mask: Numbers | None = None) -> GroupMatch:
        """Find the group of one input per network and learn from it.

        Args:
            phi: Inputs ``[*batch_size, d]``.
            mask: Networks that take part, bool ``[*batch_size]``; None: all.

        Returns:
            Matches ``[*batch_size]`` from before learning; -1 and NaN where ``mask`` is False.

        Raises:
            ValueError: If phi or mask has the wrong shape, or a phi that takes part holds NaN or
                Inf.
        """
        phi = as_tensor(phi, "phi")
        if phi.shape != (*self.batch_size, self.n_features):
            raise ValueError(
                f"phi must be {[*self.batch_size, self.n_features]}, got {[*phi.shape]}"
            )
        inputs, active = self._checked(phi, mask)
        inputs = inputs.reshape(len(active), 1, self.n_features)
        group, novelty = np.full(len(active), -1), np.full(len(active), np.nan)
        for i in np.flatnonzero(active):
            network = self._networks[i]
            (group[i],), (novelty[i],) = network.lookup(inputs[i])
            is_new = network.show(inputs[i], int(group[i]))
            n_clustered = len(network.cluster)
            due = n_clustered + max(self.smallest, n_clustered // 100)
            if is_new and len(network.points) >= due:
                network.fit_metric(len(network.points))
                network.cluster = density_clusters(
                    network.places(network.points), smallest=self.smallest, evidence=self.evidence
                )
                network.arrange()
        return self._match(group, novelty, phi)

    def get_extra_state(self) -> list[dict[str, Any]]:
        """Return demonstrations and groups of each network, for ``state_dict``."""
        return [
            {
                **{name: torch.from_numpy(getattr(network, name).copy()) for name in _ARRAYS},
                **{name: [*getattr(network, name)] for name in _LISTS},
                "revision": network.revision,
            }
            for network in self._networks
        ]

    def set_extra_state(self, state: list[dict[str, Any]]) -> None:
        """Restore the result of `get_extra_state`.

        Raises:
            ValueError: If it is damaged, or of another number of networks or features; nothing has
                changed then.
        """
        sizes = [entry["points"].shape[-1] for entry in state]
        if sizes != [self.n_features] * len(self._networks):
            raise ValueError(
                f"the state has groups of {len(sizes)} networks of {set(sizes)} features, this "
                f"BehaviorGroups {len(self._networks)} of {self.n_features}: build it with the "
                "same sizes"
            )
        self._networks = [self._network(entry) for entry in state]

    def _network(self, state: dict[str, Any] | None = None) -> _Network:
        """Return a network in the given state, or an empty one."""
        k = self.smallest // 2
        if state is None:
            none = np.empty(0, np.int64)
            return _Network(k, np.empty((0, self.n_features)), none, none, none.astype(bool), none)
        arrays: dict[str, Any] = {name: state[name].numpy().copy() for name in _ARRAYS}
        lists: dict[str, Any] = {name: [*state[name]] for name in _LISTS}
        network = _Network(k, **arrays, **lists, revision=state["revision"])
        sizes = {len(arrays[name]) for name in ("points", "shown", "group", "member")}
        if len(sizes) > 1 or not {*network.group.tolist()} <= {*range(len(network.parent))}:
            raise ValueError("a group is missing in the state: load one that state_dict returned")
        network.fit_metric(len(network.cluster))
        network.measure()
        return network

    def _checked(
        self, phi: Tensor, mask: Numbers | None
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return inputs as an array, and which networks take part ``[networks]``."""
        active = torch.ones(self.batch_size, dtype=torch.bool)
        if mask is not None:
            active = as_mask(mask, self.batch_size).cpu()
        inputs = phi.detach().cpu().double().numpy()
        if phi.shape[-1:] != (self.n_features,) or not np.isfinite(inputs[active.numpy()]).all():
            raise ValueError(
                f"phi must be {self.n_features} features without NaN and Inf, got {[*phi.shape]}"
            )
        return inputs, active.flatten().numpy()

    def _match(
        self, group: NDArray[np.int64], novelty: NDArray[np.float64], phi: Tensor
    ) -> GroupMatch:
        shape = phi.shape[:-1]
        return GroupMatch(
            group=torch.from_numpy(group).view(shape).to(phi.device),
            novelty=torch.from_numpy(novelty).float().view(shape).to(phi.device),
            batch_size=shape,
        )

    def _per_network(self, numbers: list[int]) -> Tensor:
        return torch.tensor(numbers).view(self.batch_size)


@dataclass
class _Network:
    """Groups of one network.

    Attributes:
        k: Neighbors by which distances to a group are measured.
        points: The different demonstrations, in the order in which they were first shown, [n, d].
        shown: How often each was shown, [n].
        group: Group of each, [n].
        member: Whether it is in the cluster of the group, [n]; False for outliers, and for those
            that have come since all were clustered.
        cluster: Cluster of each of those that there were when they were last clustered; -1 for
            outliers.
        parent: Parent of each group, by number.
        links: Pairs of demonstrations whose clusters are one group.
        revision: See `BehaviorGroups.revision`.
        reach: By group, the 99 % quantile of its members' distances to their k-th neighbor in it.
        metric: Linear map [d, d] after which distances are measured.
    """

    k: int
    points: NDArray[np.float64]
    shown: NDArray[np.int64]
    group: NDArray[np.int64]
    member: NDArray[np.bool_]
    cluster: NDArray[np.int64]
    parent: list[int] = field(default_factory=lambda: [0])
    links: list[tuple[int, int]] = field(default_factory=list)
    revision: int = 0
    reach: dict[int, float] = field(default_factory=dict)
    metric: NDArray[np.float64] = field(init=False)

    def __post_init__(self) -> None:
        self.metric = np.eye(self.points.shape[1])

    def fit_metric(self, n_points: int) -> None:
        """Measure distances as the first demonstrations suggest, all that are being clustered."""
        if n_points > 1:
            self.metric = local_whitening(self.points[:n_points])

    def places(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return points where their Euclidean distances are those of the metric."""
        return points @ self.metric

    def lookup(self, inputs: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return group and novelty ``[m]`` of inputs ``[m, d]``."""
        if not self.reach:
            return np.zeros(len(inputs), np.int64), np.full(len(inputs), np.inf)
        members, of_member = self.points[self.member], self.group[self.member]
        distances = cdist(self.places(inputs), self.places(members))
        group = of_member[distances.argmin(1)]
        novelty = np.empty(len(inputs))
        for number in np.unique(group):
            to_group = distances[np.ix_(group == number, of_member == number)]
            kth = np.partition(to_group, self.k - 1, axis=1)[:, self.k - 1]
            novelty[group == number] = kth / self.reach[number]
        return group, novelty

    def show(self, point: NDArray[np.float64], group: int) -> bool:
        """Count a demonstration ``[1, d]``; return whether it is new."""
        # A demonstration embedded in another batch is rounded otherwise. As a second point so near
        # the first, it would say that the data hardly have a dimension.
        off = np.linalg.norm(self.points - point, axis=1)
        same = off <= _ROUNDING * np.linalg.norm(point)
        is_new = not same.any()
        if is_new:
            same = np.append(same, True)
            self.points = np.concatenate([self.points, point])
            self.shown, self.group = np.append(self.shown, 0), np.append(self.group, group)
            self.member = np.append(self.member, False)
        self.shown[same] += 1
        return is_new

    def join(self, first: int, second: int) -> None:
        """Join two groups from now on."""
        self.links.append((self._densest(first), self._densest(second)))
        self.arrange()

    def _densest(self, group: int) -> int:
        """Return the demonstration of a group whose k-th neighbor in it is the nearest."""
        rows = np.flatnonzero(self.member & (self.group == group))
        return int(rows[self._kth_distances(rows).argmin()])

    def _kth_distances(self, rows: NDArray[np.int64]) -> NDArray[np.floating]:
        """Return the distance of each of some demonstrations to its k-th neighbor among them."""
        points = self.places(self.points[rows])
        return np.partition(cdist(points, points), self.k, axis=1)[:, self.k]

    def arrange(self) -> None:
        """Turn the clusters into groups, matched with the groups so far."""
        before = self.group
        labels = np.full(len(self.points), -1)
        labels[: len(self.cluster)] = self._linked()
        common = np.zeros((labels.max() + 1, len(self.parent)), np.int64)
        inside = labels >= 0
        np.add.at(common, (labels[inside], before[inside]), self.shown[inside])
        number: dict[int, int] = {}
        for at in np.argsort(-common, axis=None, kind="stable").tolist():
            cluster, group = divmod(at, common.shape[1])
            if common[cluster, group] and cluster not in number and group not in number.values():
                number[cluster] = group
        for cluster in np.unique(labels[inside]).tolist():
            if cluster not in number:
                number[cluster] = len(self.parent)
                self.parent.append(int(common[cluster].argmax()))
        self.group = np.array([number.get(label, -1) for label in labels.tolist()])
        self.member = inside
        self.measure()
        self.group[~inside] = self.lookup(self.points[~inside])[0]
        self.revision += int((self.group != before).any())

    def _linked(self) -> NDArray[np.int64]:
        """Return the clusters, of which linked ones have the same label."""
        labels, inside = self.cluster.copy(), np.flatnonzero(self.cluster >= 0)
        for link in self.links:
            ends, others = self.places(self.points[[*link]]), self.places(self.points[inside])
            nearest = cdist(ends, others).argmin(1)
            one, other = labels[inside[nearest]]
            labels[labels == other] = one
        return labels

    def measure(self) -> None:
        """Measure the reach of each group."""
        self.reach = {}
        for number in np.unique(self.group[self.member]).tolist():
            members = np.flatnonzero(self.member & (self.group == number))
            self.reach[number] = float(np.quantile(self._kth_distances(members), _KNOWN_SHARE))
