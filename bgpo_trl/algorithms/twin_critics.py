"""TD3 and SAC in place of DDPG as the RL algorithm f_RL: learners with twin critics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from bgpo_trl.algorithms.rl import RL, Learner, LearnerSpec, RLEntry, of_expert
from bgpo_trl.configs import SACConfig, TD3Config
from bgpo_trl.modules.actor_critic import Actor
from bgpo_trl.modules.gaussian_actors import GaussianActor
from bgpo_trl.objectives.off_policy import OffPolicyLoss
from bgpo_trl.objectives.twin_critics import SACLoss, TD3Loss
from bgpo_trl.seeding import normal

__all__ = ["SACLearner", "TD3Learner", "make_sac", "make_td3"]


class TD3Learner(Learner):
    """Learner whose actor and targets are updated once in ``policy_delay`` updates of its critics.

    (Fujimoto et al., 2018.) Arguments as for `Learner`.
    """

    def __init__(self, actor: Any, loss: OffPolicyLoss, config: TD3Config) -> None:
        super().__init__(actor, loss, config, noise=config.noise)
        self.policy_delay, self.n_updates = config.policy_delay, 0
        self.loss_actor = torch.zeros(actor.batch_size[0])

    def learn(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Take a gradient step; ``loss_actor`` is that of the latest actor update, 0 before."""
        parts = super().learn(batch)
        self.n_updates += 1
        self.loss_actor = parts.get("loss_actor", self.loss_actor)
        return {"loss_actor": self.loss_actor, **parts}

    def losses(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Return the losses, without that of the actor if its update is not due."""
        if self.actor_is_due:
            return super().losses(batch)
        return {"loss_value": self.loss.loss_value(batch)[0]}

    @property
    def actor_is_due(self) -> bool:
        """Whether the next update also updates the actor: every ``policy_delay``-th does."""
        return (self.n_updates + 1) % self.policy_delay == 0

    def state_dict(self) -> dict[str, Any]:
        """Return the states of loss and optimizer, and the number of updates."""
        latest = {"n_updates": self.n_updates, "loss_actor": self.loss_actor}
        return {**super().state_dict(), **latest}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a `state_dict`."""
        super().load_state_dict(state)
        self.n_updates, self.loss_actor = state["n_updates"], state["loss_actor"]


class SACLearner(Learner):
    """Learner that explores by sampling from its policy (Haarnoja et al., 2018)."""

    actor: GaussianActor

    def act(
        self, tensordict: TensorDictBase, generators: Sequence[torch.Generator], expert: Tensor
    ) -> Tensor:
        """Return actions drawn for a training step; see `Learner.act`."""
        noise = normal(generators, [self.actor.action_dim]).unsqueeze(1)
        noise = noise.expand(*self.actor.batch_size, -1)
        device = next(self.actor.parameters()).device
        drawn = self.actor.sample(self._for_all(tensordict), noise.to(device))
        return of_expert(drawn["action"], expert).cpu()


def make_td3(config: TD3Config, spec: LearnerSpec) -> Learner:
    """Return a TD3 learner (Fujimoto et al., 2018)."""
    actor = spec.actor(Actor, config)
    loss = TD3Loss(
        actor,
        spec.twin_critics(config),
        policy_noise=config.policy_noise,
        noise_clip=config.noise_clip,
        pre_tanh_penalty=config.pre_tanh_penalty,
        generator=spec.generators("target noise"),
        **spec.loss_options(config),
    )
    return TD3Learner(actor, loss, config)


def make_sac(config: SACConfig, spec: LearnerSpec) -> Learner:
    """Return a SAC learner with a learned temperature (Haarnoja et al., 2018)."""
    actor = spec.actor(GaussianActor, config)
    loss = SACLoss(
        actor,
        spec.twin_critics(config),
        alpha_init=config.alpha_init,
        target_entropy=config.target_entropy * spec.action_size,
        entropy_in_target=config.entropy_in_target,
        generator=spec.generators("policy samples"),
        **spec.loss_options(config),
    )
    return SACLearner(actor, loss, config)


RL["td3"] = RLEntry(make_td3, TD3Config())
RL["sac"] = RLEntry(make_sac, SACConfig())
