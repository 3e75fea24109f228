"""Dist-NLL (Sec. IV-B): policy with a head per task, distilled from one DDPG teacher per task."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.func import functional_call

from bgpo_trl.algorithms.algorithm import Policy
from bgpo_trl.algorithms.rl import make_learner
from bgpo_trl.algorithms.task_algorithm import TaskAlgorithm
from bgpo_trl.configs import DistNLLConfig
from bgpo_trl.modules.actor_critic import Actor
from bgpo_trl.modules.multi_head_actor import MultiHeadActor
from bgpo_trl.objectives.supervised import distillation_loss
from bgpo_trl.seeding import generators


class DistNLL(TaskAlgorithm):
    """Policy distillation from teachers that are still learning; the policies read the state only.

    Unlike BGPO, it knows the task label in training and tests.

    1. Training episodes are played by the teacher of their task, with exploration noise.
    2. An update is one of every teacher, each with its own replay and critic.
    3. At the end of a seed's episode, its multi-task policy learns the teachers' current actions in
       ``samples`` states of each task. A head is added once its task has data; trunk and other
       heads are kept.
    4. Test episodes are played by the multi-task policy with the head of the true label.

    Attributes:
        learner: The teachers, stacked ``[S, T]``.
        students: The multi-task policy of each seed; not stacked, since seeds end their episodes at
            different times.
    """

    config: DistNLLConfig
    needs_replay = False

    def __init__(self, config: DistNLLConfig, **arguments: Any) -> None:
        super().__init__(config, **arguments)
        self.learner = make_learner(config.rl, self.spec)
        self.students: list[MultiHeadActor] = [
            self.spec.network(MultiHeadActor, config.rl, (), stream)
            for stream in generators(self.seeds, "student")
        ]
        # By seed: the task of each head, in order of appearance.
        self._head_tasks: list[list[int]] = [[] for _ in self.seeds]
        self._heads = generators(self.seeds, "heads")
        self._student_optimizers = [
            torch.optim.Adam(student.parameters(), lr=self.config.learning_rate, fused=True)
            for student in self.students
        ]
        self._ended = torch.zeros(self.n_seeds, dtype=torch.bool)
        # Called with the parameters of a `Policy`.
        self.test_actor = self.spec.network(Actor, config.rl, (), None)

    def store(self, transition: TensorDictBase) -> None:
        """Add a transition of each seed to the replay of its task."""
        super().store(transition)
        self._ended |= transition.get(("next", "done")).flatten()

    def update(self) -> dict[str, Tensor]:
        """Update each seed's teachers; distill them if an episode has ended since the last call."""
        ended, self._ended = self._ended, torch.zeros_like(self._ended)
        if not self.ready():
            return {}
        losses = self.learn(self.sample_tasks())
        for index in ended.nonzero().flatten().tolist():
            self._distill(index)
        return losses

    def _distill(self, index: int) -> None:
        """Train the multi-task policy of a seed on its teachers' current actions."""
        tasks, student = self._head_tasks[index], self.students[index]
        optimizer = self._student_optimizers[index]
        for task in self.ready_tasks()[index].tolist():
            if task >= 0 and task not in tasks:
                tasks.append(task)
                head = student.add_head(self._heads[index])
                optimizer.add_param_group({"params": list(head.parameters())})
        rows = torch.tensor([tasks]).unsqueeze(-1).expand(-1, -1, self.config.samples)
        drawn = self.replay.sample(rows, seeds=[index]).squeeze(0)
        # The weights are 0 where the replay holds no transition of a task any more.
        batch = self.to_device(drawn.select(self.config.observed, "priority_weight"))
        alone = [self.proposals and self.proposals.clone_is_better(index, t) for t in tasks]
        seed = torch.full((len(tasks),), index, device=self.device)
        with torch.no_grad():
            teachers = self.learner.policy_weights(
                seed, torch.tensor(tasks, device=self.device), torch.tensor([*map(bool, alone)])
            )
            shown = functional_call(self.learner.policy, teachers, (batch.copy(),))
        batch.set("teacher_action", shown["action"])
        for part in batch.split(self.config.distillation_batch_size, dim=1):
            loss = distillation_loss(student, part)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()

    def snapshot(
        self, index: int, embedding: Tensor, task: Tensor, generator: torch.Generator
    ) -> Policy:
        """Copy the multi-task policy of one seed, as one network for each task.

        The network of a task without data is zero.
        """
        del embedding, generator
        tasks, student = self._head_tasks[index], self.students[index]
        like = {key: torch.zeros_like(value) for key, value in self.test_actor.named_parameters()}
        each = [
            student.policy(tasks.index(number)) if number in tasks else like
            for number in range(self.n_tasks)
        ]
        parameters = {key: torch.stack([one[key] for one in each]).cpu() for key in like}
        return self.policy(parameters, network=task)

    def state_dict(self) -> dict[str, Any]:
        """Return everything that future actions, updates and snapshots depend on."""
        return {
            **super().state_dict(),
            "tasks": [list(tasks) for tasks in self._head_tasks],
            "heads": [generator.get_state() for generator in self._heads],
            "students": [dict(student.state_dict()) for student in self.students],
            "student_optimizers": [o.state_dict() for o in self._student_optimizers],
            "ended": self._ended.clone(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a `state_dict`."""
        super().load_state_dict(state)
        self._ended = state["ended"].clone()
        for index, tasks in enumerate(state["tasks"]):
            student, optimizer = self.students[index], self._student_optimizers[index]
            for _ in tasks[len(self._head_tasks[index]) :]:
                optimizer.add_param_group({"params": list(student.add_head().parameters())})
            self._head_tasks[index] = list(tasks)
            student.load_state_dict(state["students"][index])
            optimizer.load_state_dict(state["student_optimizers"][index])
            self._heads[index].set_state(state["heads"][index])
