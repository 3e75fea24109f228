"""Learners: how policies explore and improve, as DDPG, TD3 and SAC do."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from bgpo_trl.configs import RLConfig, TD3Config
from bgpo_trl.modules.gaussian_actor import GaussianActor
from bgpo_trl.objectives.off_policy import OffPolicyLoss
from bgpo_trl.objectives.target_update import ForeachSoftUpdate
from bgpo_trl.seeding import normal

__all__ = ["Learner", "SACLearner", "TD3Learner"]


class Learner:
    """The policies of all seeds and how they improve: as they are, DDPG's.

    Its optimizer is Adam on the sum of the loss's parts. Adam treats each weight by itself, so one
    for all networks is one for each.

    Args:
        actor: Called with what it reads, writes the ``action`` without noise. Its weights lead with
            ``[S]``.
        loss: Reads transitions ``[S, B]`` and returns, among others, entries ``loss_...`` ``[]`` to
            be minimized, each a sum over the seeds. It has target networks.
        config: Its ``gamma``, ``tau`` and ``learning_rate`` are used here.
        noise: Standard deviation of the Gaussian exploration noise.

    Attributes:
        config: The hyperparameters.
        optimizer: Of all that the loss is to learn.
        target_update: Of the target networks.
    """

    def __init__(
        self, actor: Any, loss: OffPolicyLoss, config: RLConfig, *, noise: float = 0.0
    ) -> None:
        loss.make_value_estimator(gamma=config.gamma)
        self.actor, self.loss, self.config, self.noise = actor, loss, config, noise
        self.target_update = ForeachSoftUpdate(loss, tau=config.tau)
        learned = [p for p in loss.parameters() if p.requires_grad]
        self.optimizer = torch.optim.Adam(learned, lr=config.learning_rate, fused=True)

    def act(
        self, tensordict: TensorDictBase, generators: Sequence[torch.Generator], expert: Tensor
    ) -> Tensor:
        """Return actions of a training step, ``[S, 4]`` in [-1, 1], on the CPU.

        Args:
            tensordict: What the policies read, ``[S]``.
            generators: Sources of exploration, one for each seed.
            expert: Which expert of each seed acts, int64 ``[S]``.
        """
        action = self.actor(self._for_all(tensordict))["action"]
        return self.explore(_of_expert(action, expert), generators)

    def _for_all(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return what is read ``[S]`` by all experts, ``[S, E]``."""
        return tensordict.unsqueeze(1).expand(*self.actor.batch_size)

    def explore(self, action: Tensor, generators: Sequence[torch.Generator]) -> Tensor:
        """Return actions ``[S, 4]`` with each seed's Gaussian noise, within [-1, 1]."""
        noise = self.noise * normal(generators, action.shape[1:])
        return (action.cpu() + noise).clamp(-1.0, 1.0)

    def learn(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Take a gradient step on transitions ``[S, E, B]``, and one of the target networks.

        Returns:
            The parts of the loss that the step minimized, sums over seeds and experts ``[]``.
        """
        parts = self.losses(batch)
        self.optimizer.zero_grad()
        torch.stack([*parts.values()]).sum().backward()
        self.optimizer.step()
        if self.actor_is_due:
            self.target_update.step()
        return {key: value.detach() for key, value in parts.items()}

    def losses(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Return the parts of the loss to be minimized on transitions ``[S, E, B]``."""
        return {str(k): v for k, v in self.loss(batch).items() if str(k).startswith("loss_")}

    @property
    def actor_is_due(self) -> bool:
        """Whether the next update is one of the actor and the target networks, too."""
        return True

    def state_dict(self) -> dict[str, Any]:
        """Return all that future updates depend on."""
        return {"loss": dict(self.loss.state_dict()), "optimizer": self.optimizer.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from what `state_dict` returned."""
        self.loss.load_state_dict(state["loss"])
        self.optimizer.load_state_dict(state["optimizer"])


class TD3Learner(Learner):
    """Updates actor and target networks less often than the critics (Fujimoto et al., 2018).

    Args:
        actor: As in `Learner`.
        loss: As in `Learner`; ``loss_actor`` is the part that waits.
        config: Hyperparameters.

    Raises:
        ValueError: If ``policy_delay`` is less than 1.
    """

    loss: OffPolicyLoss

    def __init__(self, actor: Any, loss: OffPolicyLoss, config: TD3Config) -> None:
        if config.policy_delay < 1:
            raise ValueError(f"policy_delay must be at least 1, got {config.policy_delay}")
        super().__init__(actor, loss, config, noise=config.noise)
        self.policy_delay, self.n_updates = config.policy_delay, 0
        self.loss_actor = torch.zeros(())

    def learn(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Take a gradient step on transitions ``[S, E, B]``; see `Learner.learn`.

        Returns:
            The parts of the loss; ``loss_actor`` is that of the actor's latest update, or 0.
        """
        parts = super().learn(batch)
        self.n_updates += 1
        self.loss_actor = parts.get("loss_actor", self.loss_actor)
        return {"loss_actor": self.loss_actor, **parts}

    def losses(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Return the parts of the loss; without the actor's, where it waits."""
        if self.actor_is_due:
            return super().losses(batch)
        return {"loss_value": self.loss.loss_value(batch)[0]}

    @property
    def actor_is_due(self) -> bool:
        """Whether the next update is the last of ``policy_delay``."""
        return (self.n_updates + 1) % self.policy_delay == 0

    def state_dict(self) -> dict[str, Any]:
        """Return all that future updates depend on."""
        latest = {"n_updates": self.n_updates, "loss_actor": self.loss_actor}
        return {**super().state_dict(), **latest}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from what `state_dict` returned."""
        super().load_state_dict(state)
        self.n_updates, self.loss_actor = state["n_updates"], state["loss_actor"]


class SACLearner(Learner):
    """Explores by what its stochastic policy draws (Haarnoja et al., 2018)."""

    actor: GaussianActor

    def act(
        self, tensordict: TensorDictBase, generators: Sequence[torch.Generator], expert: Tensor
    ) -> Tensor:
        """Return actions drawn for a training step; see `Learner.act`."""
        noise = normal(generators, [self.actor.action_dim]).unsqueeze(1)
        noise = noise.expand(*self.actor.batch_size, -1)
        device = next(self.actor.parameters()).device
        drawn = self.actor.sample(self._for_all(tensordict), noise.to(device))
        return _of_expert(drawn["action"], expert).cpu()


def _of_expert(values: Tensor, expert: Tensor) -> Tensor:
    """Return those of one expert of each seed, ``[S, ...]`` of ``[S, E, ...]``."""
    seed = torch.arange(len(values), device=values.device)
    return values[seed, expert.to(values.device)]
