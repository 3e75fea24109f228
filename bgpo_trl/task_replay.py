"""Experience replay for learners that know the tasks apart: one for each task of each seed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

from bgpo_trl.modules.entries import lacking
from bgpo_trl.replay import ReplayBuffer

__all__ = ["TaskReplay"]


class TaskReplay:
    """A replay of its own for each task of each seed, for learners that know the tasks apart.

    Args:
        capacity: transitions kept of each task of each seed.
        batch_size: transitions ``B`` drawn of each by :meth:`sample`.
        generator: source of the sampled indices, ``T`` for each of ``S`` seeds.
        keys: entries to store.

    Raises:
        ValueError: if there is no task, or no task could ever fill a batch.

    Examples:
        >>> streams = [[torch.Generator() for _ in range(3)] for _ in range(10)]
        >>> replay = TaskReplay(1000, batch_size=2, generator=streams, keys=["state"])
        >>> played = {"state": torch.ones(10, 5), "task": torch.arange(10) % 2}
        >>> for _ in range(4):
        ...     replay.add(TensorDict(played, [10]))
        >>> replay.sizes[0].tolist(), replay.sample()["priority_weight"][0].tolist()
        ([4, 0, 0], [[1.0, 1.0], [0.0, 0.0], [0.0, 0.0]])
    """

    def __init__(
        self,
        capacity: int,
        *,
        batch_size: int,
        generator: Sequence[Sequence[torch.Generator]],
        keys: Sequence[NestedKey],
    ) -> None:
        if not generator or not generator[0]:
            raise ValueError("give a generator for each task of each seed, at least one")
        self.batch_size = batch_size
        self._shape = torch.Size([len(generator), len(generator[0])])
        self._keys = list(keys)
        if capacity < batch_size:
            raise ValueError(f"capacity must be at least batch_size {batch_size}, got {capacity}")
        self._buffer = ReplayBuffer(
            capacity,
            batch_size=batch_size,
            generator=[stream for streams in generator for stream in streams],
            keys=keys,
        )

    @property
    def sizes(self) -> Tensor:
        """Number of transitions held of each task of each seed, int64 ``[S, T]``."""
        return self._buffer.sizes.view(self._shape)

    @property
    def ready(self) -> Tensor:
        """Which tasks of each seed fill a batch without repetition, bool ``[S, T]``."""
        return self.sizes >= self.batch_size

    @property
    def enough(self) -> int:
        """Transitions that fill a batch of some task, whichever tasks they are of.

        Learning that waits for them begins with the same step for all seeds, so that none begins
        earlier, or counts more steps in its optimizer, than it would alone.
        """
        return self._shape[1] * (self.batch_size - 1) + 1

    def __len__(self) -> int:
        """Returns the number of transitions that every seed holds at least, of all tasks."""
        return int(self.sizes.sum(-1).min())

    def add(self, transition: TensorDictBase) -> None:
        """Stores one transition of each seed with its task.

        Args:
            transition: batch size ``[S]``, with the entries to store and ``"task"`` int64 ``[S]``.

        Raises:
            ValueError: if an entry is missing, or there is no such task.
        """
        n_seeds, n_tasks = self._shape
        task = transition.get("task", None)
        if task is None:
            raise lacking("TaskReplay", transition, ["task"])
        mask = torch.arange(n_tasks) == task.unsqueeze(-1)
        if not mask.any(-1).all():
            raise ValueError(f"task must lie in 0..{n_tasks - 1}, got {task.tolist()}")
        kept = transition.select(*self._keys).unsqueeze(1).expand(n_seeds, n_tasks)
        self._buffer.add(kept.reshape(n_seeds * n_tasks), mask.view(-1))

    def sample(
        self,
        batch_size: int | None = None,
        *,
        generator: Sequence[torch.Generator] | None = None,
    ) -> TensorDict:
        """Draws transitions of each task of each seed.

        Args:
            batch_size: how many of each, by default the ``batch_size`` of the replay.
            generator: sources of the indices in place of the replay's own, ``S * T``.

        Returns:
            Batch size ``[S, T, B]``, with ``"priority_weight"``, by which losses of TorchRL weight
            a transition: 1, or 0 for tasks that are not `ready`; those have zeros in all entries.
        """
        batch_size = self.batch_size if batch_size is None else batch_size
        ready = self.ready.view(-1)
        rows = ready.nonzero().flatten().tolist()
        if not rows:
            raise ValueError("no task fills a batch yet")
        sources = None if generator is None else [generator[row] for row in rows]
        drawn = self._buffer.sample(batch_size, seeds=rows, generator=sources)
        drawn.set("priority_weight", torch.ones(drawn.batch_size))
        every = TensorDict(batch_size=[len(ready), batch_size])
        for key, value in drawn.items(True, True):
            padded = value.new_zeros(len(ready), *value.shape[1:])
            padded[rows] = value
            every.set(key, padded)
        return every.view(*self._shape, batch_size)

    def sample_seed(self, seed: int, tasks: Sequence[int], batch_size: int) -> TensorDict:
        """Draws transitions of some tasks of one seed, ``[len(tasks), B]``.

        Args:
            seed: position of the seed.
            tasks: which, in this order; each holds a transition at least.
            batch_size: how many of each.
        """
        rows = [seed * self._shape[1] + task for task in tasks]
        return self._buffer.sample(batch_size, seeds=rows)

    def state_dict(self) -> dict[str, Any]:
        """Returns the filled part (a copy) and the states of the generators."""
        return self._buffer.state_dict()

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned, so that the same samples follow."""
        self._buffer.load_state_dict(state_dict)
