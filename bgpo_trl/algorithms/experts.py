"""Experts: separate networks for each group of behaviors, of which only the active ones learn."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from math import inf
from typing import Any

import torch
from torch import Tensor

from bgpo_trl.algorithms.learner import Learner
from bgpo_trl.objectives.noise import SeededNoise

__all__ = ["ActiveGroups", "Experts"]

State = dict[str, Tensor]
_MOMENTS, _NOISE = "optimizer.", "noise."


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
    number, so that an update costs as much as groups are active. When a group rests, its networks,
    targets, optimizer moments and random generators are put aside until it is played again, and do
    not change until then. A new group starts from its parent's networks, without moments.

    Args:
        make: Makes a learner of a stack ``[S, E]``, given ``E``.
        active: The active groups, from now on changed only by `play` and `rest`.
        parent: Returns the parent of a group, given the position of the seed; group 0 has none.

    Attributes:
        learner: The learner of today; another one when ``E`` changes.
    """

    def __init__(
        self,
        make: Callable[[int], Learner],
        active: ActiveGroups,
        parent: Callable[[int, int], int],
    ) -> None:
        self._make, self.active, self._parent = make, active, parent
        self.learner = make(1)
        # By seed: whose networks are in each slot, and those put aside.
        self._placed: list[list[int]] = [[] for _ in active.groups]
        self._aside: list[dict[int, State]] = [{} for _ in active.groups]

    @property
    def width(self) -> int:
        """Number ``E`` of slots."""
        return self.learner.actor.batch_size[1]

    def play(self, groups: Sequence[int]) -> Tensor:
        """Activate the group of each seed's episode; return its slots, int64 ``[S]``."""
        for seed, group in enumerate(groups):
            self.active.play(seed, group)
        self._arrange()
        pairs = zip(self._placed, groups, strict=True)
        return torch.tensor([placed.index(group) for placed, group in pairs])

    def rest(self, seed: int, group: int) -> None:
        """Put the networks of an active group aside, until it is played again."""
        self.active.rest(seed, group)
        self._arrange()

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
        """Restore a `state_dict`; the state of the learner, whose ``E`` changes, is loaded next."""
        self.active.load_state_dict(state["active"])
        self._placed = [[*groups] for groups in self.active.groups]
        if self._wanted_width != self.width:
            self.learner = self._make(self._wanted_width)
        device = next(self.learner.loss.parameters()).device
        self._aside = [
            {
                group: {k: v if k.startswith(_NOISE) else v.to(device) for k, v in saved.items()}
                for group, saved in row.items()
            }
            for row in state["aside"]
        ]

    @property
    def _wanted_width(self) -> int:
        return self.active.group.shape[1]

    def _arrange(self) -> None:
        """Move the networks of the active groups to their slots."""
        changed = [
            (seed, placed, now)
            for seed, (placed, now) in enumerate(zip(self._placed, self.active.groups, strict=True))
            if placed != now
        ]
        if not changed:
            return
        for seed, placed, now in changed:
            for slot, group in enumerate(placed):
                if group != (now[slot] if slot < len(now) else -1):
                    state = self._read(seed, slot)
                    self._aside[seed][group] = {key: value.clone() for key, value in state.items()}
                    placed[slot] = -1
        if self._wanted_width != self.width:
            self.learner = _resized(self.learner, self._make(self._wanted_width))
        for seed, placed, now in changed:
            del placed[len(now) :]
            placed += [-1] * (len(now) - len(placed))
            for slot, group in enumerate(now):
                if placed[slot] != group:
                    self._write(seed, slot, self._start(seed, group))
                    placed[slot] = group

    def _start(self, seed: int, group: int) -> State:
        """Return what a group that becomes active starts with, and take it from aside."""
        origin = self._with_networks(seed, group)
        if group == origin and group in self._aside[seed]:
            return self._aside[seed].pop(group)
        inherited = self._state(seed, origin)
        return {k: v.clone() for k, v in inherited.items() if not k.startswith(_MOMENTS)}

    def _with_networks(self, seed: int, group: int) -> int:
        """Return the group, or its nearest ancestor that has networks."""
        while group and group not in self._aside[seed] and group not in self._placed[seed]:
            group = self._parent(seed, group)
        return group

    def _state(self, seed: int, group: int) -> State:
        if group in self._aside[seed]:
            return self._aside[seed][group]
        placed = self._placed[seed]
        # Before the first step, the networks of group 0 are those of the first slot.
        return self._read(seed, placed.index(group) if group in placed else 0)

    def _read(self, seed: int, slot: int) -> State:
        """Return all that makes up an expert: views of tensors, states of generators."""
        tensors = _tensors(self.learner, self._shape)
        noise = {
            key: generators[seed * self.width + slot].get_state()
            for key, generators in _generators(self.learner, self._shape)
        }
        return {key: value[seed, slot] for key, value in tensors.items()} | noise

    def _write(self, seed: int, slot: int, state: State) -> None:
        for key, value in _tensors(self.learner, self._shape).items():
            value[seed, slot] = state.get(key, 0.0)
        for key, generators in _generators(self.learner, self._shape):
            generators[seed * self.width + slot].set_state(state[key].clone())

    @property
    def _shape(self) -> torch.Size:
        return torch.Size([len(self._placed), self.width])


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


def _generators(learner: Learner, batch: torch.Size) -> Iterator[tuple[str, list[torch.Generator]]]:
    """Yield the generators of a learner's losses, one for each expert in the order of the stack."""
    for name, module in learner.loss.named_modules():
        if isinstance(module, SeededNoise) and len(module.generators) == batch.numel():
            yield f"{_NOISE}{name}", module.generators


def _resized(learner: Learner, other: Learner) -> Learner:
    """Give ``other`` the state of a learner, of which it has more or fewer columns ``E``."""
    state, like = learner.state_dict(), other.state_dict()
    n_seeds, width = learner.actor.batch_size
    new_width = other.actor.batch_size[1]
    kept = min(width, new_width)

    def fitted(value: Any, to: Any) -> Any:
        if not isinstance(value, Tensor) or value.shape == to.shape:
            return value
        columns = to.clone().reshape(n_seeds, new_width, -1)
        columns[:, :kept] = value.reshape(n_seeds, width, -1)[:, :kept]
        return columns.view(to.shape)

    state["loss"] = {key: fitted(value, like["loss"][key]) for key, value in state["loss"].items()}
    parameters = [p for group in other.optimizer.param_groups for p in group["params"]]
    moments = {
        number: {
            key: fitted(value, value if key == "step" else torch.zeros_like(parameters[number]))
            for key, value in of_parameter.items()
        }
        for number, of_parameter in state["optimizer"]["state"].items()
    }
    other.load_state_dict({**state, "optimizer": {**state["optimizer"], "state": moments}})
    return other
