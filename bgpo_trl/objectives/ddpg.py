"""DDPG loss for sparse rewards and a stack of seeds."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from bgpo_trl.configs import DDPGConfig
from bgpo_trl.objectives.off_policy import OffPolicyLoss

__all__ = ["DDPGLoss"]


class DDPGLoss(OffPolicyLoss):
    """DDPG loss (Lillicrap et al., 2016; Eq. 8 of the paper).

    1. Target: ``r + gamma * Q'(s', pi'(s'))`` with target networks, clipped to ``return_bounds``.
       With an extrinsic reward of 0 or 1 that ends the episode and an intrinsic reward of at most
       ``beta`` at its end, returns lie in ``[0, 1 + beta]``; if time-outs pay the intrinsic reward
       and bootstrap, up to ``beta + gamma * (1 + beta)``.
    2. The actor minimizes ``-Q(s, pi(s)) + pre_tanh_penalty * pre_tanh_action ** 2``.

    Without bounds and penalty, this is :class:`torchrl.objectives.DDPGLoss` with
    ``delay_actor=True``, which diverges on sparse rewards: Q grows to hundreds and every action
    saturates.

    Reads and returns the entries of `OffPolicyLoss`, and returns ``"pre_tanh_magnitude"`` ``[*S]``,
    the root mean square of the actor's output before the tanh.

    Args:
        actor_network: Policy; it must write ``"pre_tanh_action"`` unless the penalty is 0.
        value_network: Q-function.
        pre_tanh_penalty: Weight of the penalty, 0 for none.
        **common: Other arguments of `OffPolicyLoss`.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from bgpo_trl.modules.actor_critic import Actor, Critic
        >>> from bgpo_trl.objectives.off_policy import ForeachSoftUpdate
        >>> seeds = {"in_keys": ["state"], "batch_size": (10,)}
        >>> loss = DDPGLoss(Actor(6, 4, **seeds), Critic(6, 4, **seeds), return_bounds=(0.0, 1.0))
        >>> loss.make_value_estimator(gamma=0.95)
        >>> target_update = ForeachSoftUpdate(loss, tau=0.005)
        >>> state, zero = torch.randn(10, 256, 6), torch.zeros(10, 256, 1)
        >>> after = {"state": state, "reward": zero, "terminated": zero.bool()}
        >>> batch = {"state": state, "action": torch.zeros(10, 256, 4), "next": after}
        >>> losses = loss(TensorDict(batch, [10, 256]))
        >>> (losses["loss_actor"] + losses["loss_value"]).backward()
    """

    actor_keys = ("pre_tanh_magnitude",)

    def __init__(
        self,
        actor_network: TensorDictModuleBase,
        value_network: TensorDictModuleBase,
        *,
        pre_tanh_penalty: float = DDPGConfig.pre_tanh_penalty,
        **common: Any,
    ) -> None:
        super().__init__(actor_network, value_network, pre_tanh_penalty=pre_tanh_penalty, **common)

    def next_value(self, successor: TensorDictBase) -> Tensor:
        """Return the values ``[*S, *B]`` of the target policy's actions."""
        data = self.call_network("target_actor_network", successor)
        return self.values("target_value_network", data)

    def loss_actor(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute the actor's loss, reduced, and ``"pre_tanh_magnitude"``."""
        data = self.call_network("actor_network", self.current(tensordict))
        value = self.values("value_network", data, frozen=True)
        return self.penalized(value, data, tensordict)
