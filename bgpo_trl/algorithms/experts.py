"""Experts: separate networks for each group of behaviors, of which only the active ones learn."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from bgpo_trl.algorithms.learner import Learner

__all__ = ["ActiveGroups", "Experts"]

State = dict[str, Tensor]
_MOMENTS = "optimizer."


class ActiveGroups:
    """Groups played most recently by each seed ``S``, in a fixed number ``E`` of slots.

    A group that is played takes a free slot, or that of the least recently played group.

    Example:
        >>> active = ActiveGroups(1, 2)
        >>> for group in (0, 1, 0, 2):
        ...     slot = active.play(0, group)
        >>> active.group
        tensor([[0, 2]])
    """

    def __init__(self, n_seeds: int, n_slots: int) -> None:
        self._slots = [[-1] * n_slots for _ in range(n_seeds)]
        self._order = [list(range(n_slots)) for _ in range(n_seeds)]  # most recent last

    @property
    def group(self) -> Tensor:
        """The group in each slot, int64 ``[S, E]``; -1 in a free slot."""
        return torch.tensor(self._slots)

    def slot(self, seed: int, group: int) -> int | None:
        """Return the slot of a group, or None if it is not active."""
        slots = self._slots[seed]
        return slots.index(group) if group in slots else None

    def play(self, seed: int, group: int) -> int:
        """Mark a group as the most recent of a seed; return its slot."""
        slot, order = self.slot(seed, group), self._order[seed]
        if slot is None:
            slot = order[0]
            self._slots[seed][slot] = group
        order.remove(slot)
        order.append(slot)
        return slot

    def rest(self, seed: int, group: int) -> int:
        """Free the slot of an active group, and return it."""
        slot, order = self._slots[seed].index(group), self._order[seed]
        self._slots[seed][slot] = -1
        order.remove(slot)
        order.insert(0, slot)
        return slot

    def rows(self, n_rows: int) -> Tensor:
        """Assign the active groups in turn to ``n_rows`` rows, int64 ``[S, n_rows]``."""
        active = [[group for group in slots if group >= 0] or [-1] for slots in self._slots]
        return torch.tensor([[groups[i % len(groups)] for i in range(n_rows)] for groups in active])

    def state_dict(self) -> dict[str, Any]:
        """Return the groups and the order in which they were played."""
        return {"slots": [[*s] for s in self._slots], "order": [[*o] for o in self._order]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a `state_dict`."""
        self._slots = [[*slots] for slots in state["slots"]]
        self._order = [[*order] for order in state["order"]]


class Experts:
    """Networks of a learner, one set for each group of behaviors of each seed.

    The learner's networks are a stack ``[S, E]``, those of the active groups. When a group becomes
    active, the networks, targets and optimizer moments of the least recently played group are put
    aside until it is played again. An update thus costs the same for any number of groups and
    leaves inactive groups unchanged. A new group starts from its parent's networks, without
    moments.

    Args:
        learner: Learner of a stack ``[S, E]``.
        active: The active groups, from now on changed only by `play`.
        parent: Returns the parent of a group, given the position of the seed; group 0 has none.
    """

    def __init__(
        self, learner: Learner, active: ActiveGroups, parent: Callable[[int, int], int]
    ) -> None:
        self.learner, self.active, self._parent = learner, active, parent
        self._batch = active.group.shape
        self._aside: list[dict[int, State]] = [{} for _ in range(self._batch[0])]

    def play(self, groups: Sequence[int]) -> Tensor:
        """Activate the group of each seed's episode; return its slots, int64 ``[S]``."""
        return torch.tensor([self._play(seed, group) for seed, group in enumerate(groups)])

    def rest(self, seed: int, group: int) -> None:
        """Put the networks of an active group aside, until it is played again."""
        slot = self.active.rest(seed, group)
        self._aside[seed][group] = self._copy(seed, slot)

    def actor_weights(self, seed: int, group: int) -> State:
        """Copy the weights of a group's policy to the CPU, given the position of the seed.

        A group without networks (not yet played) uses those of its nearest ancestor.
        """
        prefix = "actor_network_params."
        state = self._state(seed, self._with_networks(seed, group))
        return {
            key.removeprefix(prefix): value.to("cpu", copy=True)
            for key, value in state.items()
            if key.startswith(prefix)
        }

    def state_dict(self) -> dict[str, Any]:
        """Return the networks put aside, and the active groups."""
        aside = [{group: dict(state) for group, state in row.items()} for row in self._aside]
        return {"active": self.active.state_dict(), "aside": aside}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a `state_dict`; the learner is loaded separately."""
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
            aside[before[slot]] = self._copy(seed, slot)
        if group or state:
            self._write(seed, slot, state)
        return slot

    def _with_networks(self, seed: int, group: int) -> int:
        """Return the group, or its nearest ancestor that has networks."""
        while group and group not in self._aside[seed] and self.active.slot(seed, group) is None:
            group = self._parent(seed, group)
        return group

    def _state(self, seed: int, group: int) -> State:
        slot = self.active.slot(seed, group)
        if slot is None and group in self._aside[seed]:
            return self._aside[seed][group]
        return self._read(seed, slot or 0)  # before the first step, group 0 has no slot

    def _read(self, seed: int, slot: int) -> State:
        tensors = _tensors(self.learner, self._batch)
        return {key: value[seed, slot] for key, value in tensors.items()}

    def _copy(self, seed: int, slot: int) -> State:
        return {key: value.clone() for key, value in self._read(seed, slot).items()}

    def _write(self, seed: int, slot: int, state: State) -> None:
        for key, value in _tensors(self.learner, self._batch).items():
            value[seed, slot] = state.get(key, 0.0)


def _tensors(learner: Learner, batch: torch.Size) -> State:
    """Return the tensors of a learner with a row for each expert, ``[S, E, ...]``."""
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
