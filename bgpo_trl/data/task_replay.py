"""Replay buffer sampled by task."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, cast

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

from bgpo_trl.data.demonstration_replay import DemonstrationReplay
from bgpo_trl.data.group_replay import GroupReplay
from bgpo_trl.errors import missing_key

__all__ = ["TaskReplay"]


class TaskReplay:
    """Replay buffer that draws the same number of transitions from each task.

    Args:
        capacity: Transitions kept for each seed, over all tasks.
        n_tasks: Number of tasks ``T``.
        batch_size: Transitions ``B`` that `sample` draws from each task.
        generator: Random generators for sampling, one for each of ``S`` seeds.
        keys: Entries to store.
        demonstrations: Replay of the demonstrations shown, the source of a share of each batch.
        demonstration_share: That share, in [0, 1).

    Raises:
        ValueError: If there is no task, or no task could ever fill a batch.

    Example:
        >>> streams, keys = [torch.Generator() for _ in range(10)], ["state"]
        >>> replay = TaskReplay(1000, n_tasks=3, batch_size=2, generator=streams, keys=keys)
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
        n_tasks: int,
        batch_size: int,
        generator: Sequence[torch.Generator],
        keys: Sequence[NestedKey],
        demonstrations: DemonstrationReplay | None = None,
        demonstration_share: float = 0.0,
    ) -> None:
        if n_tasks < 1 or not generator:
            raise ValueError("there must be at least one seed and one task")
        if capacity < batch_size:
            raise ValueError(f"capacity must be at least batch_size {batch_size}, got {capacity}")
        self.batch_size, self.n_tasks = batch_size, n_tasks
        self._replay = GroupReplay(capacity, generator=generator, keys=keys)
        self._demonstrations = demonstrations
        self._n_shown = round(demonstration_share * batch_size)
        self._tasks = torch.arange(n_tasks).expand(len(generator), n_tasks)

    @property
    def sizes(self) -> Tensor:
        """Number of transitions held of each task of each seed, int64 ``[S, T]``."""
        return self._replay.sizes(self._tasks)

    @property
    def ready(self) -> Tensor:
        """Whether each task of each seed holds at least a batch, bool ``[S, T]``."""
        return self.sizes >= self.batch_size

    @property
    def enough(self) -> int:
        """Number of transitions that guarantees a full batch of some task.

        Waiting for it makes learning start at the same step for all seeds, as each would alone.
        """
        return self.n_tasks * (self.batch_size - 1) + 1

    def __len__(self) -> int:
        """Return the smallest number of transitions held for a seed, over all tasks."""
        return len(self._replay)

    def add(self, transition: TensorDictBase) -> None:
        """Store one transition of each seed by task; also the demonstration, if an episode ends.

        ``transition`` ``[S]`` has the entries to store and ``"task"`` int64 ``[S]``.

        Raises:
            ValueError: If an entry is missing, or a task does not exist.
        """
        task = transition.get("task", None)
        if task is None:
            raise missing_key("TaskReplay", transition, ["task"])
        if not ((task >= 0) & (task < self.n_tasks)).all():
            raise ValueError(f"task must lie in 0..{self.n_tasks - 1}, got {task.tolist()}")
        self._replay.add(transition, task)
        if self._demonstrations is not None:
            ended = transition.get(("next", "done")).flatten()
            self._demonstrations.add(transition, torch.ones(len(task)), task, ended)

    def sample(self) -> TensorDictBase:
        """Draw transitions ``[S, T, B]`` of each task of each seed, those of demonstrations last.

        They have ``"priority_weight"``, the weight in TorchRL's losses: 1, or 0 for tasks that are
        not `ready` and for demonstrations of a task of which none was shown yet.

        Raises:
            ValueError: If no task is ready.
        """
        task = self._ready_tasks()
        if self._demonstrations is None or not len(self._demonstrations):
            return self._draw(self._replay, task, self.batch_size)
        played = self._draw(self._replay, task, self.batch_size - self._n_shown)
        shown = self._draw(self._demonstrations, task, self._n_shown)
        played["demonstrated"] = torch.zeros(played.shape, dtype=torch.bool)
        return cast(TensorDictBase, torch.cat([played, shown], -1))

    def sample_played(
        self, batch_size: int, *, generator: Sequence[torch.Generator] | None = None
    ) -> TensorDict:
        """Draw as `sample` does, but ``batch_size`` transitions of each task and no demonstrations.

        ``generator`` are random generators of the seeds, in place of the replay's.
        """
        return self._draw(self._replay, self._ready_tasks(), batch_size, generator=generator)

    def sample_seed(self, seed: int, tasks: Sequence[int], batch_size: int) -> TensorDict:
        """Draw transitions ``[len(tasks), B]`` of some tasks of the seed at a position.

        ``"priority_weight"`` is 0 for tasks that hold none.
        """
        task = torch.tensor([tasks])
        return self._draw(self._replay, task, batch_size, seeds=[seed])[0]

    def state_dict(self) -> dict[str, Any]:
        """Return the states of the buffers and their generators."""
        shown = self._demonstrations
        return {
            "played": self._replay.state_dict(),
            "shown": None if shown is None else shown.state_dict(),
        }

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore a `state_dict`, so that the same samples follow."""
        self._replay.load_state_dict(state_dict["played"])
        if self._demonstrations is not None:
            self._demonstrations.load_state_dict(state_dict["shown"])

    def _ready_tasks(self) -> Tensor:
        ready = self.ready
        if not ready.any():
            raise ValueError("no task fills a batch yet")
        return torch.where(ready, self._tasks, -1)

    @staticmethod
    def _draw(
        replay: GroupReplay | DemonstrationReplay, task: Tensor, n_rows: int, **options: Any
    ) -> TensorDict:
        rows = task.repeat_interleave(n_rows, dim=1)
        return replay.sample(rows, **options).view(*task.shape, n_rows)
