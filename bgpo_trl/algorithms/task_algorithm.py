"""Base class of the algorithms that know the task label: networks and a replay for each task."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from bgpo_trl.algorithms.algorithm import Algorithm
from bgpo_trl.algorithms.rl import LearnerSpec
from bgpo_trl.configs.algorithms import TaskConfig


class TaskAlgorithm(Algorithm):
    """Algorithm with one policy per task, stacked ``[S, T]``, which plays its training episodes.

    The policies read the state only. The bank provides the tasks and, with a
    ``demonstration_share``, demonstrations as experience.

    Attributes:
        spec: Shapes and inputs of the networks, one per task.
    """

    config: TaskConfig

    def __init__(self, config: TaskConfig, **arguments: Any) -> None:
        super().__init__(config, **arguments)
        if config.share_batch and config.task_batch_size < 2 * self.n_tasks:
            raise ValueError(
                f"task_batch_size must be at least {2 * self.n_tasks} where {self.n_tasks} tasks "
                f"share it, so that each has an even number, got {config.task_batch_size}"
            )
        self.spec = LearnerSpec(
            seeds=self.seeds,
            in_keys=[config.observed],
            in_features=self.state_size,
            action_size=self.scene.action_size,
            return_bounds=(0.0, 1.0),
            device=self.device,
            experts=range(self.n_tasks),
        )
        self.replay = self.make_replay()
        self.shown = self.demonstrations()
        self._tasks = torch.arange(self.n_tasks).expand(self.n_seeds, -1)
        # As many transitions as guarantee a full batch of some task. Waiting for them makes
        # learning start at the same step for all seeds, as each would alone.
        self._enough = self.n_tasks * (config.task_batch_size - 1) + 1
        if config.rl.replay_size < self._enough:
            raise ValueError(
                f"replay_size must be at least {self._enough}, so that a batch of one of "
                f"{self.n_tasks} tasks is full and learning begins, got {config.rl.replay_size}"
            )

    @torch.no_grad()
    def act(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the ``action`` ``[S, A]`` of the tasks' policies with exploration noise."""
        task = tensordict["task"]
        return tensordict.set("action", self.act_by(tensordict, task.tolist(), task))

    def store(self, transition: TensorDictBase) -> None:
        """Store a transition of each seed and, at the end of an episode, its demonstration."""
        task: Tensor = transition["task"]
        self.replay.add(transition, task)
        if self.shown is not None:
            ended = transition.get(("next", "done")).flatten()
            self.shown.add(transition, torch.ones(self.n_seeds), task, ended)
        self.count_episodes(transition, task)

    def ready(self) -> bool:
        """Return whether there are enough transitions for an update."""
        return len(self.replay) >= max(self.config.rl.warmup_steps, self._enough)

    def ready_tasks(self) -> Tensor:
        """Return the tasks ``[S, T]`` that hold at least a batch of transitions, -1 for others."""
        full = self.replay.sizes(self._tasks) >= self.config.task_batch_size
        return torch.where(full, self._tasks, -1)

    def sample_tasks(self) -> TensorDictBase:
        """Draw transitions ``[S, T, B]`` for an update, none of tasks that are not ready.

        ``B`` is even if ``task_batch_size`` is. Where the tasks of a seed share it, rows beyond a
        task's share weigh nothing, and the others so much more that means are over them alone.
        """
        tasks, size = self.ready_tasks().unsqueeze(-1), self.config.task_batch_size
        if not self.config.share_batch:
            return self.sample(lambda n: tasks.expand(-1, -1, n), size)
        share = size // (tasks >= 0).sum(1, keepdim=True).clamp_min(1)
        share -= share % (2 - size % 2)
        n_rows = int(share.max())
        rows = torch.where(torch.arange(n_rows) < share, tasks, -1)
        batch = self.replay.sample(rows)
        return batch.set("priority_weight", batch["priority_weight"] * (n_rows / share))
