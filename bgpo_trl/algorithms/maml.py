"""MAML over DDPG (Sec. IV-B): one policy that adapts to a task by one gradient step."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from bgpo_trl.algorithms.algorithm import Policy
from bgpo_trl.algorithms.rl import Learner
from bgpo_trl.algorithms.task_algorithm import TaskAlgorithm
from bgpo_trl.configs import MAMLConfig
from bgpo_trl.modules.actor_critic import Actor
from bgpo_trl.objectives.maml import MAMLLoss
from bgpo_trl.seeding import generators


class MAML(TaskAlgorithm):
    """MAML with one critic and one replay per task; the policy reads the state only.

    Unlike BGPO, it knows the task label in training and tests, by which it selects data to adapt
    to.

    1. Training episodes are played by the policy adapted to their task, with exploration noise.
    2. An update adapts the policy to transitions of each task, evaluates the adapted policies with
       the tasks' critics on other transitions, and improves the original policy (`MAMLLoss`). Tasks
       with too few transitions are left out.
    3. Test episodes of a task are played by the policy after one gradient step on
       ``adaptation_size`` transitions of that task, of which as many are demonstrated as in an
       update, or on the latest ones (``adapt_to_latest``).

    Attributes:
        meta_actor: The policy before adaptation, stacked ``[S]``.
    """

    config: MAMLConfig
    loss: MAMLLoss

    def __init__(self, config: MAMLConfig, **arguments: Any) -> None:
        super().__init__(config, **arguments)
        rl = config.rl
        streams = generators(self.seeds, "actor")
        self.meta_actor = self.spec.network(Actor, rl, [self.n_seeds], streams)
        self.loss = MAMLLoss(
            self.meta_actor,
            self.spec.actor(rl),
            self.spec.critic(rl),
            inner_learning_rate=config.inner_learning_rate,
            **self.spec.loss_options(rl),
        )
        # Called with adapted parameters.
        self.test_actor = self.meta_actor
        self.learner = Learner(self.meta_actor, {"": "actor_network_params"}, self.loss, rl)

    def update(self) -> dict[str, Tensor]:
        """Make one update of each seed."""
        if not self.ready():
            return {}
        batch = self.sample_tasks()
        # Demonstrations come last; interleaving gives each half the same share of them.
        order = torch.arange(batch.batch_size[-1]).view(-1, 2).T.flatten()
        return self.learn(batch[..., order])

    def snapshot(
        self, index: int, embedding: Tensor, task: Tensor, generator: torch.Generator
    ) -> Policy:
        """Copy the policy adapted to each task; episodes are played by that of their task.

        A task with too few transitions gets the policy without adaptation.
        """
        del embedding
        adapted, tasks = self.loss.each_task(), self.ready_tasks()
        if (tasks >= 0).any():
            n_rows = self.config.adaptation_size
            if self.config.adapt_to_latest:
                data = self.replay.latest(tasks, n_rows)
            else:
                draw = int(torch.randint(2**63 - 1, (), generator=generator))
                streams = [torch.Generator().manual_seed(draw) for _ in range(self.n_seeds)]
                data = self.sample(
                    lambda n: tasks.unsqueeze(-1).expand(-1, -1, n), n_rows, generator=streams
                )
            adapted = self.loss.adapt(self.to_device(data))
        parameters = {
            key: value[index].detach().to("cpu", copy=True) for key, value in adapted.items()
        }
        return self.policy(parameters, network=task)
