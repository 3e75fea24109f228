"""Replay buffer sampled by group, separately for each seed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

from bgpo_trl.data.replay import ReplayBuffer
from bgpo_trl.errors import missing_key

__all__ = ["GroupReplay", "draw_shares"]

GROUP = "group"


class GroupReplay:
    """Ring buffer of transitions labeled by group, sampled row by row from a given group.

    All groups of a seed share its capacity, so memory does not grow with the number of groups.

    Args:
        capacity: Transitions kept for each seed; the oldest are overwritten.
        generator: Random generators for sampling, one for each of ``S`` seeds.
        keys: Entries to store.
        source_key: Entry, int64 ``[S]``, that decides about the group of a transition, such as the
            number of its demonstration; stored, but not sampled. Only `regroup` needs it.

    Example:
        >>> replay = GroupReplay(100, generator=[torch.Generator()], keys=["state"])
        >>> for i in range(6):
        ...     replay.add(TensorDict({"state": torch.tensor([i])}, [1]), torch.tensor([i % 2]))
        >>> drawn = replay.sample(torch.tensor([[1, 1, 1, 7]]))
        >>> (drawn["state"][0, :3] % 2 == 1).all(), drawn["priority_weight"][0]
        (tensor(True), tensor([1., 1., 1., 0.]))
    """

    def __init__(
        self,
        capacity: int,
        *,
        generator: Sequence[torch.Generator],
        keys: Sequence[NestedKey],
        source_key: NestedKey | None = None,
    ) -> None:
        self._keys, self._source_key = list(keys), source_key
        stored = [*keys, GROUP]
        if source_key is not None and source_key not in keys:
            stored.append(source_key)
        self._buffer = ReplayBuffer(capacity, generator=list(generator), keys=stored)
        self._generators = list(generator)
        self._index = [_Index() for _ in self._generators]

    def __len__(self) -> int:
        """Return the smallest number of transitions held for a seed."""
        return len(self._buffer)

    def sizes(self, group: Tensor) -> Tensor:
        """Return the number of transitions held of each of the groups ``[S, G]``."""
        oldest = self._buffer.oldest.tolist()
        return torch.tensor(
            [
                [len(index.of(number, first)) for number in row]
                for index, first, row in zip(self._index, oldest, group.tolist(), strict=True)
            ]
        ).view(group.shape)

    def add(self, transition: TensorDictBase, group: Tensor, mask: Tensor | None = None) -> None:
        """Store one transition of each seed.

        Args:
            transition: Batch size ``[S]``, with the entries to store.
            group: Group of each transition, int64 ``[S]``, at least 0.
            mask: Seeds that store theirs, bool ``[S]``; ``None`` for all.

        Raises:
            ValueError: If an entry is missing, or differs in shape or dtype from those stored; if a
                group is negative.
        """
        if not (group if mask is None else group[mask]).ge(0).all():
            raise ValueError(f"a group must be at least 0, got {group.tolist()}")
        steps = self._buffer.n_added.tolist()
        missing = [key for key in self._buffer.keys or () if key not in transition.keys(True)]
        if set(missing) - {GROUP}:
            raise missing_key("GroupReplay", transition, missing)
        kept = transition.select(*(key for key in self._buffer.keys or () if key != GROUP))
        self._buffer.add(kept.set(GROUP, group), mask)
        chosen = range(len(steps)) if mask is None else mask.nonzero().flatten().tolist()
        groups = group.tolist()
        for seed in chosen:
            self._index[seed].append(groups[seed], steps[seed])

    def sample(
        self,
        group: Tensor,
        *,
        seeds: Sequence[int] | None = None,
        generator: Sequence[torch.Generator] | None = None,
    ) -> TensorDict:
        """Draw a transition for each row, uniformly and with replacement from the row's group.

        Args:
            group: Group of each row, int64 ``[S, R]``; -1 leaves a row empty and draws nothing.
            seeds: Positions of the ``S`` seeds to draw for; ``None`` for all.
            generator: Random generators of these seeds, in place of the replay's.

        Returns:
            Batch size ``[S, R]``, with ``"priority_weight"``, the weight of a transition in
            TorchRL's losses: 1, or 0 for rows without a group or of an empty group, whose other
            entries are undefined.

        Raises:
            ValueError: If one of these seeds holds no transition.
        """
        seeds = range(len(self._generators)) if seeds is None else seeds
        if not all(self._buffer.n_added[seed] for seed in seeds):
            raise ValueError("every seed needs a transition before the first sample")
        sources = [self._generators[seed] for seed in seeds] if generator is None else generator
        oldest = self._buffer.oldest.tolist()
        steps = np.empty(group.shape, np.int64)
        weight = np.ones(group.shape, np.float32)
        wanted, all_shares = group.numpy(), draw_shares(group, sources).numpy()
        for i, (seed, shares) in enumerate(zip(seeds, all_shares, strict=True)):
            for number in np.unique(wanted[i]).tolist():
                rows = wanted[i] == number
                held = self._index[seed].of(number, oldest[seed])
                if len(held):
                    steps[i, rows] = held[(shares[rows] * len(held)).astype(np.int64)]
                else:
                    steps[i, rows], weight[i, rows] = oldest[seed], 0.0
        drawn = self._buffer.take(torch.from_numpy(steps), self._keys, seeds=seeds)
        return drawn.set("priority_weight", torch.from_numpy(weight))

    def regroup(self, seed: int, group: Tensor) -> None:
        """Assign the transitions of a seed to groups anew.

        Args:
            seed: Position of the seed.
            group: Group of the transitions of each source, int64 ``[number of sources]``.

        Raises:
            ValueError: If the replay has no ``source_key``.
        """
        if self._source_key is None:
            raise ValueError("to regroup what is stored, give the replay a source_key")
        if not int(self._buffer.n_added[seed]):
            return
        source = self._buffer.read(seed, self._source_key)
        self._buffer.write(seed, GROUP, group[source])
        self._index[seed] = self._indexed(seed)

    def _indexed(self, seed: int) -> _Index:
        """Return the index of what the buffer holds of a seed."""
        index = _Index()
        if int(self._buffer.n_added[seed]):
            index.extend(self._buffer.read(seed, GROUP).numpy(), int(self._buffer.oldest[seed]))
        return index

    def state_dict(self) -> dict[str, Any]:
        """Return the filled part of the buffer (a copy) and the states of the generators."""
        return self._buffer.state_dict()

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore a `state_dict`, so that the same samples follow."""
        self._buffer.load_state_dict(state_dict)
        self._index = [self._indexed(seed) for seed in range(len(self._generators))]


def draw_shares(group: Tensor, generator: Sequence[torch.Generator]) -> Tensor:
    """Draw a number in [0, 1) for each row ``[S, R]`` that has a group.

    Rows without a group (-1) get 0 and consume no random numbers, so a seed's draws do not depend
    on how many slots are free.
    """
    shares = torch.zeros(group.shape, dtype=torch.float64)
    for row, wanted, source in zip(shares, group >= 0, generator, strict=True):
        row[wanted] = torch.rand(int(wanted.sum()), generator=source, dtype=torch.float64)
    return shares


class _Index:
    """Steps at which a seed stored transitions of each group, in order of time."""

    def __init__(self) -> None:
        self._steps: dict[int, NDArray[np.int64]] = {}
        self._span: dict[int, tuple[int, int]] = {}

    def append(self, group: int, step: int) -> None:
        steps = self._steps.get(group)
        first, end = self._span.get(group, (0, 0))
        if steps is None:
            steps = self._steps[group] = np.empty(1024, np.int64)
        elif end == len(steps):
            held = steps[first:end]
            steps = self._steps[group] = np.empty(2 * len(held) + 1024, np.int64)
            steps[: len(held)] = held
            first, end = 0, len(held)
        steps[end] = step
        self._span[group] = first, end + 1

    def extend(self, groups: NDArray[np.int64], first: int) -> None:
        """Append the steps from ``first`` on, of these groups, to an empty index."""
        for group in np.unique(groups).tolist():
            steps = self._steps[group] = first + np.flatnonzero(groups == group)
            self._span[group] = 0, len(steps)

    def of(self, group: int, oldest: int) -> NDArray[np.int64]:
        """Return the steps of a group that have not been overwritten."""
        if group not in self._steps:
            return np.empty(0, np.int64)
        steps, (first, end) = self._steps[group], self._span[group]
        if first < end and steps[first] < oldest:
            first += int(np.searchsorted(steps[first:end], oldest))
            self._span[group] = first, end
        return steps[first:end]
