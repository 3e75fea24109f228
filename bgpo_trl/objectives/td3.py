"""TD3 loss for sparse rewards and a stack of seeds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from bgpo_trl.configs import TD3Config
from bgpo_trl.objectives.off_policy import OffPolicyLoss, SeededNoise

__all__ = ["TD3Loss"]


class TD3Loss(OffPolicyLoss):
    """TD3 loss (Fujimoto et al., 2018).

    1. Target: ``r + gamma * min_i Q_i'(s', a')``, clipped to ``return_bounds``, where ``a'`` is the
       target policy's action with clipped Gaussian noise (target policy smoothing), in [-1, 1].
    2. The actor maximizes the first Q-function, with the penalty of `DDPGLoss`.

    The training loop delays the actor: `TD3Learner` calls `loss_value` alone in updates without it.
    Reads and returns the entries of `DDPGLoss`.

    Args:
        actor_network: Policy; it must write ``"pre_tanh_action"`` unless the penalty is 0.
        value_network: Twin Q-functions, ``batch_size`` ``[*S, 2]``.
        policy_noise: Standard deviation of the noise on the target action.
        noise_clip: Largest magnitude of that noise.
        pre_tanh_penalty: Weight of the penalty, 0 for none.
        generator: Sources of the noise, one per seed, as in `SeededNoise`.
        **common: Other arguments of `OffPolicyLoss`.

    Raises:
        ValueError: If the noise is negative.

    Examples:
        >>> from bgpo_trl.modules.actor_critic import Actor, Critic
        >>> actor = Actor(6, 4, in_keys=["state"], batch_size=(10,))
        >>> loss = TD3Loss(actor, Critic(6, 4, in_keys=["state"], batch_size=(10, 2)))
        >>> loss.make_value_estimator(gamma=0.95)
    """

    twin_critics = True
    actor_keys = ("pre_tanh_magnitude",)

    def __init__(
        self,
        actor_network: TensorDictModuleBase,
        value_network: TensorDictModuleBase,
        *,
        policy_noise: float = TD3Config.policy_noise,
        noise_clip: float = TD3Config.noise_clip,
        pre_tanh_penalty: float = TD3Config.pre_tanh_penalty,
        generator: torch.Generator | Sequence[torch.Generator] | None = None,
        **common: Any,
    ) -> None:
        if not (policy_noise >= 0 and noise_clip >= 0):
            raise ValueError(
                f"policy_noise and noise_clip must be >= 0, got {policy_noise} and {noise_clip}"
            )
        super().__init__(actor_network, value_network, pre_tanh_penalty=pre_tanh_penalty, **common)
        self.policy_noise, self.noise_clip = policy_noise, noise_clip
        self.noise = SeededNoise(self.batch_size, generator)

    def next_value(self, successor: TensorDictBase) -> Tensor:
        """Return the smaller values ``[*S, *B]`` of the smoothed target actions."""
        data = self.call_network("target_actor_network", successor)
        action = data.get(self.tensor_keys.action)
        noise = (self.noise(action) * self.policy_noise).clamp(-self.noise_clip, self.noise_clip)
        data.set(self.tensor_keys.action, (action + noise).clamp(-1.0, 1.0))
        return self.values("target_value_network", data).amin(len(self.batch_size))

    def loss_actor(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute the actor's loss, reduced, and ``"pre_tanh_magnitude"``."""
        data = self.call_network("actor_network", self.current(tensordict))
        values = self.values("value_network", data, frozen=True)
        return self.penalized(values.select(len(self.batch_size), 0), data, tensordict)
