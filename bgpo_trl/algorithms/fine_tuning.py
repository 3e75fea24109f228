"""Fine-tuning: each task is learned from its own transitions alone, by one policy."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from bgpo_trl.algorithms.bgpo import BGPO
from bgpo_trl.configs import FineTuningConfig

__all__ = ["FineTuning"]


class FineTuning(BGPO):
    """One policy that goes on learning where a task begins, from an empty replay.

    It is given the boundaries of tasks, and by default no context: a lower bound for methods
    against forgetting (Wolczyk et al., 2021, "Continual World"). It is meant for the sequential
    schedule, in which only the newest task is played. ``ddpg`` in that schedule differs in that it
    still learns from the transitions of earlier tasks.

    After a boundary, a seed rests until its replay holds ``warmup_steps`` transitions again, as
    before its first update: it acts, and its actor and critic do not change.
    """

    config: FineTuningConfig
    _n_steps = 0

    def store(self, transition: TensorDictBase) -> None:
        """Store a transition of each seed."""
        super().store(transition)
        self._n_steps += 1

    def update(self) -> dict[str, Tensor]:
        """Make one update of each seed whose replay holds ``warmup_steps`` transitions."""
        rl = self.config.rl
        # All seeds share the optimizer's count of updates, so these begin by the number of steps.
        if self._n_steps < rl.warmup_steps:
            return {}
        group = torch.where(self.n_held() >= rl.warmup_steps, 0, -1).view(-1, 1, 1)
        return self.learn(self.sample(lambda n: group.expand(-1, -1, n), rl.batch_size))

    def n_held(self) -> Tensor:
        """Return the number of transitions in the replay of each seed, int64 ``[S]``."""
        return self.replay.sizes(torch.zeros(self.n_seeds, 1, dtype=torch.int64)).flatten()

    def begin_task(self, index: int, task: int) -> None:
        """Empty the replay of the seed, which then rests until it has filled again."""
        del task
        self.replay.clear(index)
        self.learner.clear_momentum(index)

    def state_dict(self) -> dict[str, Any]:
        """Return everything that future actions, updates and snapshots depend on."""
        return {**super().state_dict(), "n_steps": self._n_steps}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a `state_dict`."""
        super().load_state_dict(state)
        self._n_steps = state["n_steps"]
