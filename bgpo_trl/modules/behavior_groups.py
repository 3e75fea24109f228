"""Groups of behaviors, found without labels as clusters of the demonstrations shown so far."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from tensordict import TensorClass
from torch import Tensor

from bgpo_trl.errors import as_shape
from bgpo_trl.modules.density_clusters import density_clusters, least_size, local_whitening
from bgpo_trl.modules.group_trials import GroupTrials
from bgpo_trl.modules.gwr import Numbers, as_tensor

_KNOWN_SHARE = 0.99  # of a group's own demonstrations that are to count as known
_FITTING_SHARE = 0.9  # of a group's own demonstrations whose starts are to count as fitting
_BETWEEN_CODES = 0.02  # of a start's numbers, as a bank stores them
_ROUNDING = 1e-4  # of a vector's length; shipped demonstrations differ by 600 times as much
# After the first ten to twenty demonstrations of a new task, which experts of other tasks solve in
# 5 to 8 % of cases, four successes are rare.
_SOLVED = 4
# Of the state.
_ARRAYS = ("points", "starts", "shown", "tried", "won", "group", "member", "cluster")
_LISTS = ("parent", "links", "joined")


class GroupMatch(TensorClass["tensor_only"]):
    """Group of each input.

    Attributes:
        group: Number of the group, int64 ``[*batch]``. Numbers count up from 0 in order of
            appearance and are never used again.
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


class BehaviorGroups:
    """Groups of similar behaviors, found in the demonstrations that are shown one after another.

    A group is a cluster of the different demonstrations shown so far, separated from the others by
    a valley of significantly lower density (`density_clusters`). No distance is given: the same
    inputs at another scale form the same groups. Distances are measured after `local_whitening`,
    since most features of an embedding vary within each behavior, and those that tell behaviors
    apart may be the small ones.

    1. A demonstration that is shown again, or differs from an earlier one by no more than rounding
       (a ten-thousandth of its length, so inputs have to lie around 0), adds nothing. With every
       ``smallest`` new ones (beyond ``100 * smallest``: with every hundredth part more), all are
       clustered anew; until the first time, all are of group 0.
    2. An input belongs to the group of the nearest clustered demonstration. Its novelty is the
       distance to the group's ``k``-th nearest, divided by the 99 % quantile of this distance among
       the group's own demonstrations; ``k`` is half the `least_size` of a cluster.
    3. Groups keep their number when they are clustered anew. Clusters and groups are matched in the
       order of the number of times that the demonstrations they have in common were shown. So, of a
       group that splits, the larger part keeps the number; of groups that merge, the result has
       that of the group played most. A cluster that is left over becomes a new group, whose parent
       is the group with which it has most in common.
    4. Groups that turn out to be one behavior can be joined (`join`), and stay so: the clusters of
       their densest demonstrations are one group from then on. If such a group splits, a cluster
       belongs to it as long as the group's expert has succeeded four times after the cluster's
       demonstrations, and does not fall short, by more than a standard deviation, of half its rate
       after the others. The first demonstrations of a new task may be of this group too, but its
       expert does not solve them.

    A task that looks different from different starts, such as a push to the left or to the right,
    forms several groups. The expert of each does not know what to do where the group's own
    demonstrations never began. Where the starts of demonstrations are given, too,

    5. a start *fits* a group if its distance to the nearest start of the group's demonstrations is
       at most the 90 % quantile of this distance among those starts themselves;
    6. where a start does not fit the group shown, the episode is played by the expert of that group
       or of one that it fits, whichever `GroupTrials.select` draws (`expert`);
    7. two groups whose experts succeed after each other's demonstrations are joined (`end`).

    Each seed has groups of its own.

    Args:
        n_features: Size d of an input.
        smallest: Least number of different demonstrations of a group among few (`least_size`).
        evidence: Depth of a significant valley, in multiples of what chance explains.
        seed: Seed of the trials.

    Raises:
        ValueError: If ``smallest`` is below 4 or ``evidence`` is not positive.

    Attributes:
        trials: Successes of the experts of groups after demonstrations of others.
        points: The different demonstrations, in the order in which they were first shown, [n, d].
        starts: First state of each, [n, f]; f is 0 if they are not given.
        shown: How often each was shown, [n].
        tried: How often the expert of its group then played, [n].
        won: How often this expert succeeded, [n].
        group: Group of each, [n].
        member: Whether it is in the cluster of the group, [n]; False for outliers, and for those
            that have come since all were clustered.
        cluster: Cluster of each of those that there were when they were last clustered; -1 for
            outliers.
        parent: Parent of each group, by number; that of group 0 is 0.
        links: Pairs of demonstrations whose clusters are one group.
        joined: Numbers of the groups that were joined from others.
        revision: How often earlier demonstrations have changed their groups.

    Examples:
        >>> groups = BehaviorGroups(3)
        >>> inputs = torch.randn(60, 3, generator=torch.Generator().manual_seed(0))
        >>> inputs[1::2] += 10
        >>> for x in inputs:
        ...     match = groups.adapt(x)
        >>> groups.numbers, groups.lookup(torch.tensor([[0.0] * 3, [10.0] * 3, [5.0] * 3])).known
        ([0, 1], tensor([ True,  True, False]))
    """

    def __init__(
        self, n_features: int, *, smallest: int = 10, evidence: float = 1.0, seed: int = 0
    ) -> None:
        (self.n_features,) = as_shape([n_features], "n_features")
        if not (smallest >= 4 and smallest == int(smallest) and 0 < evidence < np.inf):
            raise ValueError(
                "smallest must be a whole number of at least 4 and evidence positive, got "
                f"{smallest} and {evidence}"
            )
        self.smallest, self.evidence = int(smallest), float(evidence)
        self.trials = GroupTrials(seed)
        self.points, self.starts = np.empty((0, self.n_features)), np.empty((0, 0), np.float32)
        self.member = np.empty(0, np.bool_)
        self.shown, self.tried, self.won = (np.empty(0, np.int64) for _ in range(3))
        self.group, self.cluster = (np.empty(0, np.int64) for _ in range(2))
        self._latest = 0  # the demonstration shown last
        self.parent, self.joined, self.revision = [0], list[int](), 0
        self.links = list[tuple[int, int]]()
        # Linear map [d, d] after which distances are measured.
        self._metric = np.eye(self.n_features)
        # By group, the 99 % quantile of its members' distances to their k-th neighbor in it.
        self._reach: dict[int, float] = {}

    @property
    def _k(self) -> int:
        """Neighbors by which distances to a group are measured."""
        return least_size(len(self.cluster), self.smallest) // 2

    @property
    def numbers(self) -> list[int]:
        """Numbers of the groups, ascending; group 0 alone before the first clustering."""
        return sorted(self._reach) or [0]

    def join(self, first: int, second: int) -> None:
        """Join two groups, given their numbers, from now on.

        Raises:
            ValueError: If there is no such group, or both are the same.
        """
        if {first, second} - {*self.numbers} or first == second:
            raise ValueError(
                f"groups to join must be two of {self.numbers}, got {first} and {second}"
            )
        one, other = (
            self._densest(np.flatnonzero(self.member & (self.group == group)))
            for group in (first, second)
        )
        self.links.append((one, other))
        self._arrange()
        self.joined.append(int(self.group[one]))

    def lookup(self, phi: Numbers) -> GroupMatch:
        """Return the groups ``[*B]`` of inputs ``[*B, d]``.

        Raises:
            ValueError: If an input has another number of features, or holds NaN or Inf.
        """
        phi = as_tensor(phi, "phi")
        group, novelty = self._lookup(self._checked(phi).reshape(-1, self.n_features))
        shape = phi.shape[:-1]
        return GroupMatch(
            group=torch.from_numpy(group).view(shape).to(phi.device),
            novelty=torch.from_numpy(novelty).float().view(shape).to(phi.device),
            batch_size=shape,
        )

    def fits(self, start: Numbers, group: int) -> bool:
        """Return whether a start ``[f]`` fits a group; all do if there are too few to compare."""
        rows = np.flatnonzero(self.group == group)
        if len(rows) < least_size(len(self.points), self.smallest) or not self.starts.size:
            return True
        start, starts = as_tensor(start, "start").cpu().float(), torch.from_numpy(self.starts[rows])
        apart = torch.cdist(starts, starts).fill_diagonal_(torch.inf).amin(-1)
        # Where all episodes begin alike, a start still differs from those that a bank has stored.
        least = _BETWEEN_CODES * math.sqrt(starts.shape[1])
        limit = apart.quantile(_FITTING_SHARE).clamp_min(least)
        return bool(torch.cdist(start[None], starts).amin() <= limit)

    def expert(self, start: Numbers, group: int) -> tuple[int, bool]:
        """Return the group whose expert is to play an episode.

        Args:
            start: First state of the episode, ``[f]``.
            group: Group of its demonstration.

        Returns:
            The number of the group that plays, and whether the start fits ``group``.
        """
        if self.fits(start, group):
            return group, True
        others = [other for other in self.numbers if other != group and self.fits(start, other)]
        return self.trials.select(group, others), False

    def end(self, group: int, expert: int, *, fits: bool, success: bool) -> None:
        """Count an episode, given the results of `expert`; join groups that are one task.

        The episode is that of the demonstration learned last (`adapt`).
        """
        if {group, expert} <= {*self.numbers}:
            self.trials.count(group, expert, fits=fits, success=success)
        if group == expert:
            self.tried[self._latest] += 1
            self.won[self._latest] += success
        if (pair := self.trials.same_task()) is not None:
            self.join(*pair)

    def adapt(self, phi: Numbers, start: Numbers | None = None) -> GroupMatch:
        """Find the group of one demonstration and learn from it.

        Args:
            phi: Embedding of the demonstration, ``[d]``.
            start: Its first state, ``[f]``; given for all demonstrations or for none.

        Returns:
            The match ``[]`` from before learning.

        Raises:
            ValueError: As from `lookup`, or if starts differ in size, are not finite or no vector;
                nothing has changed then.
        """
        phi = as_tensor(phi, "phi")
        if phi.ndim != 1:
            raise ValueError(f"phi must be [{self.n_features}], got {[*phi.shape]}")
        first = np.empty(0, np.float32)
        if start is not None:
            first = as_tensor(start, "start").cpu().numpy().astype(np.float32)
        if first.ndim != 1 or not np.isfinite(first).all():
            raise ValueError(f"start must be [f] finite numbers, got {first.tolist()}")
        if len(self.points) and first.shape != self.starts.shape[1:]:
            raise ValueError(
                f"the starts of earlier demonstrations have {self.starts.shape[1]} features, this "
                f"one has {[*first.shape]}: give one of the same size for each, or for none"
            )
        match = self.lookup(phi)
        is_new = self._show(self._checked(phi), first, int(match.group))
        n_clustered = len(self.cluster)
        due = n_clustered + max(self.smallest, n_clustered // 100)
        if is_new and len(self.points) >= due:
            self._fit_metric(len(self.points))
            self.cluster = density_clusters(
                self.points @ self._metric, smallest=self.smallest, evidence=self.evidence
            )
            self._arrange()
        return match

    def state_dict(self) -> dict[str, Any]:
        """Return a copy of demonstrations and groups."""
        return {
            **{name: torch.from_numpy(getattr(self, name).copy()) for name in _ARRAYS},
            **{name: [*getattr(self, name)] for name in _LISTS},
            "latest": self._latest,
            "revision": self.revision,
            "trials": self.trials.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a `state_dict`.

        Raises:
            ValueError: If entries are missing or do not fit each other, or the number of features
                is another one; nothing has changed then.
        """
        lacking = {*_ARRAYS, *_LISTS, "latest", "revision", "trials"} - state.keys()
        if lacking:
            raise ValueError(f"the state lacks {min(lacking)}: load one that state_dict returned")
        arrays: dict[str, Any] = {name: state[name].numpy().copy() for name in _ARRAYS}
        if arrays["points"].shape[-1] != self.n_features:
            raise ValueError(
                f"the state has {arrays['points'].shape[-1]} features, these groups "
                f"{self.n_features}: build them with the same size"
            )
        sizes = {len(arrays[name]) for name in _ARRAYS if name != "cluster"}
        if len(sizes) > 1 or not {*arrays["group"].tolist()} <= {*range(len(state["parent"]))}:
            raise ValueError("a group is missing in the state: load one that state_dict returned")
        n_points = len(arrays["points"])
        shown = len(arrays["cluster"]) <= n_points and state["latest"] < max(1, n_points)
        if not shown or not np.isfinite(arrays["points"]).all():
            raise ValueError("the state has other points than were shown: load one as returned")
        vars(self).update(arrays)
        for name in _LISTS:
            setattr(self, name, [*state[name]])
        self._latest, self.revision = state["latest"], state["revision"]
        self.trials.load_state_dict(state["trials"])
        self._fit_metric(len(self.cluster))
        self._measure()

    def _checked(self, phi: Tensor) -> NDArray[np.float64]:
        """Return inputs as an array."""
        inputs = phi.detach().cpu().double().numpy()
        if phi.shape[-1:] != (self.n_features,) or not np.isfinite(inputs).all():
            raise ValueError(
                f"phi must be {self.n_features} features without NaN and Inf, got {[*phi.shape]}"
            )
        return inputs

    def _fit_metric(self, n_points: int) -> None:
        """Measure distances as the first demonstrations suggest, all that are being clustered."""
        if n_points > 1:
            self._metric = local_whitening(self.points[:n_points])

    def _lookup(self, inputs: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return group and novelty ``[m]`` of inputs ``[m, d]``."""
        if not self._reach:
            return np.zeros(len(inputs), np.int64), np.full(len(inputs), np.inf)
        members, of_member = self.points[self.member], self.group[self.member]
        distances = cdist(inputs @ self._metric, members @ self._metric)
        group = of_member[distances.argmin(1)]
        novelty = np.empty(len(inputs))
        for number in np.unique(group):
            to_group = distances[np.ix_(group == number, of_member == number)]
            kth = np.partition(to_group, self._k - 1, axis=1)[:, self._k - 1]
            novelty[group == number] = kth / self._reach[number]
        return group, novelty

    def _show(self, point: NDArray[np.float64], start: NDArray[np.float32], group: int) -> bool:
        """Count a demonstration ``[d]`` with its start ``[f]``; return whether it is new."""
        # A demonstration embedded in another batch is rounded otherwise. As a second point so near
        # the first, it would say that the data hardly have a dimension.
        off = np.linalg.norm(self.points - point, axis=1)
        same = off <= _ROUNDING * np.linalg.norm(point)
        is_new = not same.any()
        if is_new:
            same = np.append(same, True)
            self.points = np.concatenate([self.points, point[None]])
            starts = self.starts.reshape(len(self.starts), len(start))  # of no width before
            self.starts = np.concatenate([starts, start[None]])
            self.shown, self.tried, self.won = (
                np.append(counts, 0) for counts in (self.shown, self.tried, self.won)
            )
            self.group = np.append(self.group, group)
            self.member = np.append(self.member, False)
        self.shown[same] += 1
        self._latest = int(same.argmax())
        return is_new

    def _densest(self, rows: NDArray[np.int64]) -> int:
        """Return which of some demonstrations has the nearest k-th neighbor among them."""
        return int(rows[self._kth_distances(rows).argmin()])

    def _kth_distances(self, rows: NDArray[np.int64]) -> NDArray[np.floating]:
        """Return the distance of each of some demonstrations to its k-th neighbor among them."""
        points = self.points[rows] @ self._metric
        return np.partition(cdist(points, points), self._k, axis=1)[:, self._k]

    def _arrange(self) -> None:
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
        self._measure()
        self.group[~inside] = self._lookup(self.points[~inside])[0]
        self.revision += int((self.group != before).any())
        self.trials.keep(self.numbers)

    def _linked(self) -> NDArray[np.int64]:
        """Return the clusters, of which those that are one group have the same label."""
        labels, inside = self.cluster.copy(), np.flatnonzero(self.cluster >= 0)
        for link in self.links:
            ends, others = self.points[[*link]] @ self._metric, self.points[inside] @ self._metric
            nearest = cdist(ends, others).argmin(1)
            one, other = labels[inside[nearest]]
            labels[labels == other] = one
        group = self.group[: len(labels)]
        for number in sorted({*self.joined}):
            found, counts = np.unique(labels[(group == number) & (labels >= 0)], return_counts=True)
            largest, *parts = found[np.argsort(-counts, kind="stable")].tolist() or [-1]
            for part in parts:
                of_part = np.flatnonzero(labels == part)
                known = of_part[group[of_part] == number]
                others = np.flatnonzero(labels == largest)
                if 2 * len(known) > len(of_part) and self._solves(known, others):
                    labels[of_part] = largest
        return labels

    def _solves(self, part: NDArray[np.int64], others: NDArray[np.int64]) -> bool:
        """Return whether a group's expert solves a part of its demonstrations like others."""
        rate = self.won[others].sum() / max(1, self.tried[others].sum())
        won, half = self.won[part].sum(), self.tried[part].sum() * rate / 2
        return bool(won >= max(_SOLVED, half - half**0.5))

    def _measure(self) -> None:
        """Measure the reach of each group."""
        self._reach = {}
        for number in np.unique(self.group[self.member]).tolist():
            members = np.flatnonzero(self.member & (self.group == number))
            self._reach[number] = float(np.quantile(self._kth_distances(members), _KNOWN_SHARE))
