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
       ``beta``, returns lie in ``[0, 1 + beta]``.
    2. The actor minimizes ``-Q(s, pi(s)) + pre_tanh_penalty * pre_tanh_action ** 2``.

    Without bounds and penalty DDPG diverges on sparse rewards: Q grows to hundreds and every action
    saturates. With neither it is :class:`torchrl.objectives.DDPGLoss` with ``delay_actor=True``.

    Entries are those of `OffPolicyLoss`; ``"pre_tanh_magnitude"`` ``[*S]``, the root mean square of
    the actor's output before the tanh, is returned, too.

    Args:
        actor_network: Policy; it must write ``"pre_tanh_action"`` unless the penalty is 0.
        value_network: Q-function.
        pre_tanh_penalty: Weight of the penalty, 0 for none.
        **common: Other arguments of `OffPolicyLoss`.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from bgpo_trl.modules.actor_critic import Actor, Critic
        >>> from bgpo_trl.objectives.target_update import ForeachSoftUpdate
        >>> seeds = {"in_keys": ["state"], "batch_size": (10,)}
        >>> loss = DDPGLoss(Actor(6, 4, **seeds), Critic(6, 4, **seeds), return_bounds=(0.0, 1.0))
        >>> loss.make_value_estimator(gamma=0.95)
        >>> target_update = ForeachSoftUpdate(loss, tau=0.005)
        >>> shape = (10, 256)
        >>> batch = TensorDict({
        ...     "state": torch.randn(*shape, 6),
        ...     "action": torch.rand(*shape, 4) * 2 - 1,
        ...     "next": {
        ...         "state": torch.randn(*shape, 6),
        ...         "reward": torch.zeros(*shape, 1),
        ...         "terminated": torch.zeros(*shape, 1, dtype=torch.bool),
        ...     },
        ... }, shape)
        >>> losses = loss(batch)
        >>> (losses["loss_actor"] + losses["loss_value"]).backward()
        >>> losses["td_error_max"].shape
        torch.Size([10])
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
        data = self.network("target_actor_network")(successor)
        return self.values(self.network("target_value_network"), data)

    def loss_actor(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute the actor's loss and ``"pre_tanh_magnitude"``; see the base class."""
        data = self.network("actor_network")(self.inputs.current(tensordict))
        value = self.values(self.network("value_network", frozen=True), data)
        return self.penalized(value, data, tensordict)
