"""Replay buffer for one seed, or for a stack of seeds that step together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

__all__ = ["ReplayBuffer"]


class ReplayBuffer:
    """Ring buffer of transitions, sampled uniformly with replacement, each seed from its own.

    The interface follows ``torchrl.data.ReplayBuffer``. That class, with a sampler per seed, takes
    0.27 ms longer for each seed and update, 6 % of a training step of ten seeds
    (``benchmarks/speed/updates.py``).

    The first transition reserves address space for the whole capacity; the operating system commits
    memory as the buffer fills: 662 bytes per transition and seed with latents of 64, behaviors of
    32, 4 actions, a reward and two flags, so 6.6 GB for 10 full seeds of 10^6.

    Args:
        capacity: Transitions kept for each seed, 10^6 in the paper; the oldest are overwritten.
        batch_size: Transitions ``B`` that `sample` draws for each seed, 256 in the paper.
        generator: Source of the sampled indices. One generator gives a single buffer, a sequence of
            ``S`` a stack of buffers, each of which draws as a single one would.
        keys: Entries to store; ``None`` for all entries of the first transition.

    Raises:
        ValueError: If ``capacity``, ``batch_size`` or the number of generators is not positive.

    Example:
        >>> generators = [torch.Generator().manual_seed(seed) for seed in range(10)]
        >>> replay = ReplayBuffer(1000, batch_size=256, generator=generators)
        >>> replay.add(TensorDict({"state": torch.zeros(10, 3), "action": torch.zeros(10, 2)}, 10))
        >>> len(replay), replay.sample().shape
        (1, torch.Size([10, 256]))
    """

    def __init__(
        self,
        capacity: int,
        *,
        batch_size: int = 256,
        generator: torch.Generator | Sequence[torch.Generator],
        keys: Sequence[NestedKey] | None = None,
    ) -> None:
        stacked = not isinstance(generator, torch.Generator)
        self.generators = list(generator) if stacked else [generator]
        if capacity < 1 or batch_size < 1 or not self.generators:
            raise ValueError(
                "capacity, batch_size and the number of generators must be at least 1, got "
                f"{capacity}, {batch_size} and {len(self.generators)}"
            )
        self.capacity = capacity
        self.batch_size = batch_size
        self.keys = None if keys is None else list(keys)
        n_seeds = len(self.generators)
        self._shape = torch.Size([n_seeds] if stacked else [])
        self._seed = torch.arange(n_seeds)
        self._n_added = torch.zeros(n_seeds, dtype=torch.int64)
        # Transition t of seed i is row (t % capacity) * n_seeds + i, so that a step of all seeds is
        # one block and a row has a single index, for which torch has its fastest kernels.
        self._rows: dict[NestedKey, Tensor] = {}

    @property
    def n_added(self) -> Tensor:
        """Number of transitions added so far for each seed, int64 ``[*S]``."""
        return self._n_added.view(self._shape).clone()

    @property
    def oldest(self) -> Tensor:
        """Step of the oldest transition held for each seed, counted from 0, int64 ``[*S]``."""
        return (self._n_added - self.capacity).clamp(min=0).view(self._shape)

    @property
    def sizes(self) -> Tensor:
        """Number of transitions held for each seed, int64 ``[*S]``."""
        return self._n_added.clamp(max=self.capacity).view(self._shape)

    def __len__(self) -> int:
        """Return the smallest number of transitions held for a seed."""
        return int(self.sizes.min())

    def add(self, transition: TensorDictBase, mask: Tensor | None = None) -> None:
        """Store one transition of each seed.

        Args:
            transition: Batch size ``[*S]``, with the entries to store.
            mask: Seeds that store theirs, bool ``[*S]``; ``None`` for all.

        Raises:
            ValueError: If an entry is missing, or its shape or dtype differs from those stored.
        """
        if transition.batch_size != self._shape:
            raise ValueError(
                f"the transition must have batch size {[*self._shape]}, one for each seed, got "
                f"{[*transition.batch_size]}"
            )
        self._write(transition, 1, mask)

    def extend(self, transitions: TensorDictBase, mask: Tensor | None = None) -> None:
        """Store ``T`` successive transitions of each seed.

        Args:
            transitions: Batch size ``[T, *S]``, with ``T`` at most the capacity.
            mask: Transitions to store, bool ``[T, *S]``; ``None`` for all.

        Raises:
            ValueError: If an entry is missing, or its shape or dtype differs from those stored.
        """
        n_steps, *shape = transitions.batch_size or [0]
        if not 1 <= n_steps <= self.capacity or shape != [*self._shape]:
            raise ValueError(
                f"transitions must have batch size [T, *{[*self._shape]}] with 1 <= T <= "
                f"{self.capacity}, got {[*transitions.batch_size]}"
            )
        self._write(transitions, n_steps, mask)

    def sample(self, batch_size: int | None = None) -> TensorDict:
        """Draw transitions ``[*S, B]`` of each seed, uniformly and with replacement, as copies.

        Raises:
            ValueError: If a seed holds no transition, or ``batch_size`` is less than 1.
        """
        batch_size = self.batch_size if batch_size is None else batch_size
        if batch_size < 1:
            raise ValueError(f"batch_size must be at least 1, got {batch_size}")
        sizes = self.sizes.view(-1).tolist()
        if not all(sizes):
            raise ValueError(f"every seed needs a transition before the first sample, got {sizes}")
        steps = torch.stack(
            [
                torch.randint(size, (batch_size,), generator=generator)
                for size, generator in zip(sizes, self.generators, strict=True)
            ]
        )
        rows = (steps * len(self.generators) + self._seed.unsqueeze(-1)).view(-1)
        return self._read(rows, [*self._shape, batch_size])

    def take(
        self,
        steps: Tensor,
        keys: Sequence[NestedKey] | None = None,
        *,
        seeds: Sequence[int] | None = None,
    ) -> TensorDict:
        """Copy the transitions ``[S, R]`` that seeds stored at the given steps, int64 ``[S, R]``.

        Steps are at least `oldest` and less than `n_added`. ``keys`` are the entries to return and
        ``seeds`` the positions of the seeds; ``None`` is all.
        """
        columns = self._seed if seeds is None else self._seed[list(seeds)]
        rows = steps % self.capacity * len(self.generators) + columns.unsqueeze(-1)
        return self._read(rows.view(-1), steps.shape, keys)

    def read(self, seed: int, key: NestedKey) -> Tensor:
        """Copy an entry of all transitions held for a seed, oldest first, ``[N, ...]``."""
        return self._rows[key].index_select(0, self._held(seed))

    def write(self, seed: int, key: NestedKey, values: Tensor) -> None:
        """Replace an entry of all transitions held for a seed, oldest first, ``[N, ...]``."""
        self._rows[key].index_copy_(0, self._held(seed), values)

    def _held(self, seed: int) -> Tensor:
        end = int(self._n_added[seed])
        steps = torch.arange(max(0, end - self.capacity), end)
        return steps % self.capacity * len(self.generators) + seed

    def _read(
        self, rows: Tensor, batch_size: Sequence[int], keys: Sequence[NestedKey] | None = None
    ) -> TensorDict:
        batch = TensorDict(batch_size=batch_size)
        for key in self._rows if keys is None else keys:
            stored = self._rows[key]
            drawn = stored.index_select(0, rows)
            batch.set(key, drawn.view(*batch.batch_size, *stored.shape[1:]))
        return batch

    def state_dict(self) -> dict[str, Any]:
        """Return the filled part of the buffer (a copy) and the states of the generators."""
        return self._state().clone().to_dict()

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore a `state_dict`, so that the same samples follow.

        Raises:
            ValueError: If it comes from a buffer of another capacity or number of seeds.
        """
        n_added, capacity = state_dict["n_added"], int(state_dict["capacity"])
        if capacity != self.capacity or len(n_added) != len(self._n_added):
            raise ValueError(
                f"the saved replay has capacity {capacity} and {len(n_added)} seeds, this one "
                f"{self.capacity} and {len(self._n_added)}: build it with the saved sizes"
            )
        self._rows = {}
        for key, saved in TensorDict(dict(state_dict.get("rows", {}))).items(True, True):
            self._rows[key] = self._allocate(saved.shape[1:], saved.dtype)
            self._rows[key][: len(saved)] = saved
        self._n_added = n_added.clone()
        for generator, state in zip(self.generators, state_dict["generators"], strict=True):
            generator.set_state(state.clone())

    def _state(self) -> TensorDict:
        state = TensorDict(
            {
                "capacity": torch.tensor(self.capacity),
                "n_added": self._n_added,
                "generators": torch.stack([g.get_state() for g in self.generators]),
            }
        )
        longest = int(self.sizes.max())
        filled = longest * len(self.generators)
        # Zeros replace the uninitialized rows of seeds that hold fewer transitions.
        empty = (torch.arange(longest).unsqueeze(-1) >= self.sizes.view(-1)).view(-1)
        for key, stored in self._rows.items():
            if empty.any():
                stored[:filled][empty] = 0
            state.set(("rows", *key) if isinstance(key, tuple) else ("rows", key), stored[:filled])
        return state

    @torch.no_grad()
    def _write(self, transitions: TensorDictBase, n_steps: int, mask: Tensor | None) -> None:
        shape, n_seeds = transitions.batch_size, len(self.generators)
        if mask is not None and (mask.shape != shape or mask.dtype != torch.bool):
            raise ValueError(f"mask must be bool {[*shape]}, got {mask.dtype} {[*mask.shape]}")
        entries = self._checked_entries(transitions)
        if not self._rows:
            self._rows = {
                key: self._allocate(entry.shape[len(shape) :], entry.dtype)
                for key, entry in entries.items()
            }

        if mask is None:
            step = self._n_added + torch.arange(n_steps).unsqueeze(-1)
        else:
            mask = mask.view(n_steps, n_seeds)
            step = self._n_added + mask.cumsum(0) - 1
        rows = step % self.capacity * n_seeds + self._seed
        rows = rows.view(-1) if mask is None else rows[mask]
        for key, stored in self._rows.items():
            entry = entries[key].reshape(-1, *stored.shape[1:])
            stored.index_copy_(0, rows, entry if mask is None else entry[mask.view(-1)])
        self._n_added += n_steps if mask is None else mask.sum(0)

    def _checked_entries(self, transitions: TensorDictBase) -> dict[NestedKey, Tensor]:
        if not self._rows:
            if self.keys is not None:
                missing = [key for key in self.keys if key not in transitions.keys(True)]
                if missing:
                    raise ValueError(f"the transition lacks {missing}, which are to be stored")
                transitions = transitions.select(*self.keys)
            return dict(transitions.items(True, True))

        entries, n_dims = {}, len(transitions.batch_size)
        for key, stored in self._rows.items():
            entry = entries[key] = transitions.get(key, None)
            if entry is None:
                raise ValueError(f"the transition lacks {key!r}, which was stored before")
            if entry.shape[n_dims:] != stored.shape[1:] or entry.dtype != stored.dtype:
                raise ValueError(
                    f"{key!r} must be {stored.dtype} {[*stored.shape[1:]]} as stored before, got "
                    f"{entry.dtype} {[*entry.shape[n_dims:]]}"
                )
        return entries

    def _allocate(self, shape: torch.Size, dtype: torch.dtype) -> Tensor:
        # Not torch.zeros, which would commit the memory of the whole capacity at once.
        return torch.empty(self.capacity * len(self.generators), *shape, dtype=dtype)
