"""Experts: networks for each group of behaviors, and which groups learn."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import inf
from typing import Any

import torch
from torch import Tensor

from bgpo_trl.algorithms.rl import Expert, Learner


class ActiveGroups:
    """Groups that each seed ``S`` has played lately.

    A group is active from when it is played until it has not been played for ``rest_after`` steps,
    or until another one is played when ``most`` are active, and it is the one played longest ago.

    Args:
        n_seeds: Number of seeds.
        most: Largest number of active groups of a seed.
        rest_after: Steps without being played after which a group is no longer active.

    Examples:
        >>> active = ActiveGroups(1, most=2, rest_after=3)
        >>> for group in (0, 1, 0, 2):
        ...     active.play(0, group)
        >>> active.group
        tensor([[0, 2]])
        >>> for _ in range(3):
        ...     active.play(0, 2)
        >>> active.group
        tensor([[2]])
    """

    def __init__(self, n_seeds: int, most: int, rest_after: float = inf) -> None:
        self.most, self.rest_after = most, rest_after
        self.groups: list[list[int]] = [[] for _ in range(n_seeds)]
        """Active groups of each seed, by slot."""
        self._steps = [0] * n_seeds
        self._played: list[dict[int, int]] = [{} for _ in range(n_seeds)]  # by group, its last step

    @property
    def group(self) -> Tensor:
        """The group in each slot, int64 ``[S, E]``; -1 for seeds with fewer than ``E`` groups.

        ``E`` is the largest number of active groups of a seed, at least 1.
        """
        width = max(1, *map(len, self.groups))
        return torch.tensor([groups + [-1] * (width - len(groups)) for groups in self.groups])

    def play(self, seed: int, group: int) -> None:
        """Count a step of a seed that a group plays."""
        groups, played = self.groups[seed], self._played[seed]
        self._steps[seed] += 1
        played[group] = step = self._steps[seed]
        for other in [*groups]:
            if step - played[other] >= self.rest_after:
                self.rest(seed, other)
        if group in groups:
            return
        if len(groups) < self.most:
            groups.append(group)
        else:
            oldest = min(groups, key=played.__getitem__)
            groups[groups.index(oldest)] = group
            del played[oldest]

    def rest(self, seed: int, group: int) -> None:
        """End the activity of a group."""
        self.groups[seed].remove(group)
        del self._played[seed][group]

    def rows(self, n_rows: int) -> Tensor:
        """Assign the active groups in turn to ``n_rows`` rows, int64 ``[S, n_rows]``."""
        active = [groups or [-1] for groups in self.groups]
        return torch.tensor([[groups[i % len(groups)] for i in range(n_rows)] for groups in active])

    def state_dict(self) -> dict[str, Any]:
        """Return the active groups, and when each was played."""
        return {
            "groups": [[*groups] for groups in self.groups],
            "steps": [*self._steps],
            "played": [dict(played) for played in self._played],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a `state_dict`."""
        self.groups = [[*groups] for groups in state["groups"]]
        self._steps = [*state["steps"]]
        self._played = [dict(played) for played in state["played"]]


class Experts:
    """Networks of a learner, one set for each group of behaviors of each seed.

    The learner's networks are a stack ``[S, E]``, those of the active groups: ``E`` follows their
    number, so that an update costs as much as groups are active. When a group rests, its expert
    (networks, targets, moments) is put aside until the group is played again, and does not
    change until then. A new group starts from its parent's networks, without moments, and
    imitates as at first. As Adam counts the steps of all experts together, the first steps of a new
    one are up to three times as long as a new optimizer's; the parent's second moments gained
    nothing (docs/learning.md, "Tried without success").

    Args:
        learner: The learner, of one expert per seed.
        active: The active groups, from now on changed only by `play` and `rest`.
        parent: Returns the parent of a group, given the position of the seed; group 0 has none.
    """

    def __init__(
        self, learner: Learner, active: ActiveGroups, parent: Callable[[int, int], int]
    ) -> None:
        self.learner, self.active, self._parent = learner, active, parent
        # By seed: whose expert is in each slot, and the experts put aside. As group 0 need not be
        # the first to play, its expert waits there.
        seeds = range(len(active.groups))
        self._placed: list[list[int]] = [[] for _ in seeds]
        self._inactive: list[dict[int, Expert]] = [{0: learner.read(seed, 0)} for seed in seeds]

    def play(self, groups: Sequence[int]) -> Tensor:
        """Activate the group of each seed's episode; return its slots, int64 ``[S]``."""
        for seed, group in enumerate(groups):
            self.active.play(seed, group)
        self._arrange()
        pairs = zip(self._placed, groups, strict=True)
        return torch.tensor([placed.index(group) for placed, group in pairs])

    def rest(self, seed: int, group: int) -> None:
        """Put the expert of an active group aside, until the group is played again."""
        self.active.rest(seed, group)
        self._arrange()

    def state_dict(self) -> dict[str, Any]:
        """Return the active groups, and the experts put aside."""
        return {"active": self.active.state_dict(), "inactive": [{**row} for row in self._inactive]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a `state_dict`; the learner, whose ``E`` changes, is restored next."""
        self.active.load_state_dict(state["active"])
        self._placed = [[*groups] for groups in self.active.groups]
        self._inactive = [{**row} for row in state["inactive"]]
        self.learner.resize(self.active.group.shape[1])

    def _arrange(self) -> None:
        """Move the experts of the active groups to their slots."""
        before, now = self._placed, [[*groups] for groups in self.active.groups]
        if before == now:
            return
        for seed, slot, group in _moved(before, now):
            self._inactive[seed][group] = self.learner.read(seed, slot)
        arriving = [(*place, self._start(*place[::2])) for place in _moved(now, before)]
        self.learner.resize(self.active.group.shape[1])
        for seed, slot, group, expert in arriving:
            self.learner.write(seed, slot, expert)
            self._inactive[seed].pop(group, None)
        self._placed = now

    def _start(self, seed: int, group: int) -> Expert:
        """Return the expert with which a group becomes active."""
        expert = self.find(seed, group)
        if group in self._inactive[seed]:
            return expert
        # An entry that is missing becomes 0: a new group imitates with the full weight, and its
        # averages begin anew.
        networks = {k: v for k, v in expert["networks"].items() if not k.startswith("n_")}
        return {"networks": networks, "moments": {}}

    def find(self, seed: int, group: int) -> Expert:
        """Return the expert of a group, or of its nearest ancestor that has played, or group 0."""
        inactive, placed = self._inactive[seed], self._placed[seed]
        while group and group not in inactive and group not in placed:
            group = self._parent(seed, group)
        if group in inactive:
            return inactive[group]
        return self.learner.read(seed, placed.index(group))


def _moved(one: list[list[int]], other: list[list[int]]) -> list[tuple[int, int, int]]:
    """Return seed, slot and group of each slot whose group is not the same in the other."""
    return [
        (seed, slot, group)
        for seed, (ours, theirs) in enumerate(zip(one, other, strict=True))
        for slot, group in enumerate(ours)
        if theirs[slot : slot + 1] != [group]
    ]
