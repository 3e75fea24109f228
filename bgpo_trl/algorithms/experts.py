"""Experts: a network of its own for each group of behaviors, a few of which learn at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from bgpo_trl.algorithms.rl import Learner

__all__ = ["ActiveGroups", "Experts"]

State = dict[str, Tensor]
_MOMENTS = "optimizer."


class ActiveGroups:
    """The groups that each seed played last, in a fixed number of slots.

    A group that is played takes a free slot, or that of the group that was played longest ago.

    Args:
        n_seeds: Number of seeds ``S``.
        n_slots: Groups of each seed ``E`` that are active at a time.

    Example:
        >>> active = ActiveGroups(1, 2)
        >>> for group in (0, 1, 0, 2):
        ...     slot = active.play(0, group)
        >>> active.group
        tensor([[0, 2]])
    """

    def __init__(self, n_seeds: int, n_slots: int) -> None:
        self._slots = [[-1] * n_slots for _ in range(n_seeds)]
        self._order = [list(range(n_slots)) for _ in range(n_seeds)]  # the latest last

    @property
    def group(self) -> Tensor:
        """The group in each slot, int64 ``[S, E]``; -1 in a free one."""
        return torch.tensor(self._slots)

    def slot(self, seed: int, group: int) -> int | None:
        """Return the slot of a group, None if it has none."""
        slots = self._slots[seed]
        return slots.index(group) if group in slots else None

    def play(self, seed: int, group: int) -> int:
        """Make a group the latest of a seed; returns its slot."""
        slot, order = self.slot(seed, group), self._order[seed]
        if slot is None:
            slot = order[0]
            self._slots[seed][slot] = group
        order.remove(slot)
        order.append(slot)
        return slot

    def rows(self, n_rows: int) -> Tensor:
        """Return a group for each of ``n_rows`` rows, the active ones in turn, ``[S, R]``."""
        active = [[group for group in slots if group >= 0] or [-1] for slots in self._slots]
        return torch.tensor([[groups[i % len(groups)] for i in range(n_rows)] for groups in active])

    def state_dict(self) -> dict[str, Any]:
        """Return the groups and the order in which they were played."""
        return {"slots": [[*s] for s in self._slots], "order": [[*o] for o in self._order]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from what `state_dict` returned."""
        self._slots = [[*slots] for slots in state["slots"]]
        self._order = [[*order] for order in state["order"]]


class Experts:
    """The networks of a learner, one set for each group of behaviors of each seed.

    The learner's networks are a stack ``[S, E]``: those of the active groups. A group that becomes
    active takes the place of the one played longest ago, whose networks, targets and moments of
    the optimizer are put aside until it is played again. So an update costs the same however many
    groups there are, and a group that is not played is not changed. A new group starts with the
    networks of the group that it parted from, and without moments.

    Args:
        learner: Learner of a stack ``[S, E]``.
        active: The active groups; only `play` changes them from now on.
        parent: Returns the group that a group parted from, given the position of the seed and the
            group. Group 0 has none.
    """

    def __init__(
        self, learner: Learner, active: ActiveGroups, parent: Callable[[int, int], int]
    ) -> None:
        self.learner, self.active, self._parent = learner, active, parent
        self._batch = active.group.shape
        self._aside: list[dict[int, State]] = [{} for _ in range(self._batch[0])]

    def play(self, groups: Sequence[int]) -> Tensor:
        """Make the group of each seed's episode active.

        Args:
            groups: One for each seed.

        Returns:
            Their slots, int64 ``[S]``.
        """
        return torch.tensor([self._play(seed, group) for seed, group in enumerate(groups)])

    def actor_weights(self, seed: int, group: int) -> State:
        """Return copies of the weights of a group's policy, on the CPU.

        A group that was not played yet acts as the one it parted from.

        Args:
            seed: Position of the seed.
            group: A group.
        """
        prefix = "actor_network_params."
        state = self._state(seed, self._with_networks(seed, group))
        return {
            key.removeprefix(prefix): value.to("cpu", copy=True)
            for key, value in state.items()
            if key.startswith(prefix)
        }

    def state_dict(self) -> dict[str, Any]:
        """Return the networks that are put aside, and which groups are active."""
        aside = [{group: dict(state) for group, state in row.items()} for row in self._aside]
        return {"active": self.active.state_dict(), "aside": aside}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from what `state_dict` returned; the learner is loaded by itself."""
        self.active.load_state_dict(state["active"])
        device = next(self.learner.loss.parameters()).device
        self._aside = [
            {group: {k: v.to(device) for k, v in s.items()} for group, s in row.items()}
            for row in state["aside"]
        ]

    def _play(self, seed: int, group: int) -> int:
        slot = self.active.slot(seed, group)
        if slot is not None:
            return self.active.play(seed, group)
        aside = self._aside[seed]
        if group in aside:
            state = aside.pop(group)
        else:
            inherited = self._state(seed, self._with_networks(seed, group)) if group else {}
            state = {k: v.clone() for k, v in inherited.items() if not k.startswith(_MOMENTS)}
        before = self.active.group[seed].tolist()
        slot = self.active.play(seed, group)
        if before[slot] >= 0:
            aside[before[slot]] = {k: v.clone() for k, v in self._read(seed, slot).items()}
        if group or state:
            self._write(seed, slot, state)
        return slot

    def _with_networks(self, seed: int, group: int) -> int:
        """Return the group, or the nearest of those it descends from that has networks."""
        while group and group not in self._aside[seed] and self.active.slot(seed, group) is None:
            group = self._parent(seed, group)
        return group

    def _state(self, seed: int, group: int) -> State:
        slot = self.active.slot(seed, group)
        if slot is None and group in self._aside[seed]:
            return self._aside[seed][group]
        return self._read(seed, slot or 0)  # before the first step, group 0 is in no slot yet

    def _read(self, seed: int, slot: int) -> State:
        tensors = _tensors(self.learner, self._batch)
        return {key: value[seed, slot] for key, value in tensors.items()}

    def _write(self, seed: int, slot: int, state: State) -> None:
        for key, value in _tensors(self.learner, self._batch).items():
            value[seed, slot] = state.get(key, 0.0)


def _tensors(learner: Learner, batch: torch.Size) -> State:
    """Return the tensors of a learner that have a row for each expert, ``[S, E, ...]``."""
    tensors: State = {
        key: value
        for key, value in learner.loss.state_dict().items()
        if isinstance(value, Tensor) and value.shape[: len(batch)] == batch
    }
    parameters = [p for group in learner.optimizer.param_groups for p in group["params"]]
    for number, parameter in enumerate(parameters):
        for key, value in learner.optimizer.state.get(parameter, {}).items():
            if key != "step":
                tensors[f"{_MOMENTS}{number}.{key}"] = value
    return tensors
