"""Losses of TD3 and SAC, with twin critics, for sparse rewards and a stack of seeds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from bgpo_trl.configs import SACConfig, TD3Config
from bgpo_trl.objectives.off_policy import OffPolicyLoss, SeededNoise

__all__ = ["SACLoss", "TD3Loss"]


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
    noise: SeededNoise  # pyright: ignore[reportIncompatibleVariableOverride] always there
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


class SACLoss(OffPolicyLoss):
    """SAC loss (Haarnoja et al., 2018b), with a learned temperature for each seed.

    1. Target: ``r + gamma * (min_i Q_i'(s', a') - alpha * log pi(a' | s'))`` with ``a'`` drawn from
       the policy, clipped to ``return_bounds``. Without ``entropy_in_target`` the second term is
       left out: the Q-functions then predict the return alone, to which the bounds apply, and
       entropy counts in the actor's loss only (Ball et al., 2023, for sparse rewards).
    2. The actor minimizes ``alpha * log pi(a | s) - min_i Q_i(s, a)``.
    3. The temperature ``alpha`` grows while the policy's entropy is below ``target_entropy``, and
       shrinks while it is above.

    Reads and returns the entries of `OffPolicyLoss`, and returns ``"loss_alpha"`` ``[]``, to be
    added to the other losses, and ``"alpha"`` and ``"entropy"`` ``[*S]``.

    Args:
        actor_network: A `GaussianActor`, or a policy with the same ``draw`` and ``action_dim``.
        value_network: Twin Q-functions, ``batch_size`` ``[*S, 2]``.
        alpha_init: Initial temperature.
        target_entropy: Entropy of the policy, in nats over all action dimensions; None: minus their
            number.
        entropy_in_target: Whether the Q-functions include the entropy to come.
        generator: Sources of the samples, one per seed, as in `SeededNoise`.
        **common: Other arguments of `OffPolicyLoss`, except ``pre_tanh_penalty`` and
            ``delay_actor``.

    Raises:
        ValueError: If ``alpha_init`` is not positive.

    Examples:
        >>> from bgpo_trl.modules.actor_critic import Critic
        >>> from bgpo_trl.modules.gaussian_actors import GaussianActor
        >>> actor = GaussianActor(6, 4, in_keys=["state"], batch_size=(10,))
        >>> loss = SACLoss(actor, Critic(6, 4, in_keys=["state"], batch_size=(10, 2)))
        >>> loss.make_value_estimator(gamma=0.95)
        >>> loss.log_alpha.shape
        torch.Size([10])
    """

    twin_critics = True
    noise: SeededNoise  # pyright: ignore[reportIncompatibleVariableOverride] always there
    actor_keys = ("loss_alpha", "alpha", "entropy")

    def __init__(
        self,
        actor_network: Any,  # with `draw` and `action_dim`
        value_network: TensorDictModuleBase,
        *,
        alpha_init: float = SACConfig.alpha_init,
        target_entropy: float | None = None,
        entropy_in_target: bool = SACConfig.entropy_in_target,
        generator: torch.Generator | Sequence[torch.Generator] | None = None,
        **common: Any,
    ) -> None:
        if not (alpha_init > 0 and math.isfinite(alpha_init)):
            raise ValueError(f"alpha_init must be a number > 0, got {alpha_init}")
        unused: dict[str, Any] = {"pre_tanh_penalty": 0.0, "delay_actor": False}
        super().__init__(actor_network, value_network, **unused, **common)
        self.target_entropy = (
            -float(actor_network.action_dim) if target_entropy is None else target_entropy
        )
        self.entropy_in_target = entropy_in_target
        self.noise = SeededNoise(self.batch_size, generator)
        start = torch.full(self.batch_size, math.log(alpha_init))
        self.log_alpha = nn.Parameter(start.to(next(self.parameters()).device))

    def next_value(self, successor: TensorDictBase) -> Tensor:
        """Return the smaller values ``[*S, *B]`` of drawn actions, perhaps with their entropy."""
        data, log_prob = self._sample(successor)
        value = self.values("target_value_network", data).amin(len(self.batch_size))
        if self.entropy_in_target:
            value = value - self._each(self.log_alpha.detach().exp(), log_prob) * log_prob
        return value

    def loss_actor(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute the actor's loss, reduced, and the temperature's loss and entries."""
        data, log_prob = self._sample(self.current(tensordict))
        values = self.values("value_network", data, frozen=True)
        alpha = self.log_alpha.detach().exp()
        loss = self._each(alpha, log_prob) * log_prob - values.amin(len(self.batch_size))
        log_prob = log_prob.detach()
        loss_alpha = -self._each(self.log_alpha, log_prob) * (log_prob + self.target_entropy)
        return self.reduce(loss, tensordict), {
            "loss_alpha": self.reduce(loss_alpha, tensordict),
            "alpha": alpha,
            "entropy": -self.flatten_batch(log_prob).mean(-1),
        }

    def _sample(self, data: TensorDictBase) -> tuple[TensorDictBase, Tensor]:
        """Return the data with actions drawn, and their log-probabilities ``[*S, *B]``."""
        # A TensorDict without a batch size is read as one of vectors.
        batch = data.batch_size or data.get(self.input_keys[0]).shape[:-1]
        noise = self.noise(self.log_alpha.new_empty(*batch, self.actor_network.action_dim))
        data = self.actor_network.draw(self.call_network("actor_network", data), noise)
        return data, data.get(self.tensor_keys.log_prob)

    def _each(self, of_seed: Tensor, like: Tensor) -> Tensor:
        """Return values of the seeds ``[*S]`` in a shape that broadcasts with ``[*S, *B]``."""
        return of_seed.reshape(*self.batch_size, *[1] * (like.ndim - len(self.batch_size)))
