"""TD3 for sparse rewards and stacked seeds: TorchRL's loss, with noise of each seed's own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import Tensor
from torchrl import objectives

from bgpo_trl.objectives.stacked import TwinCriticLoss

__all__ = ["TD3Loss"]


class TD3Loss(TwinCriticLoss, objectives.TD3Loss):
    """TD3 loss (Fujimoto et al., 2018) for one seed or a stack of seeds.

    1. Target: ``r + gamma * min_i Q_i'(s', a')``, clipped to ``return_bounds``, where ``a'`` is the
       target policy's action with clipped Gaussian noise ("target policy smoothing"), in [-1, 1].
    2. Both Q-functions learn it; the actor climbs the first.
    3. As in :class:`~bgpo_trl.objectives.ddpg.DDPGLoss`, squared pre-tanh actions are penalized.

    The delay of the actor is not the loss's: leave ``loss_actor`` out of the sum, as
    :class:`~bgpo_trl.algorithms.rl.TD3Learner` does.

    It differs from :class:`torchrl.objectives.TD3Loss` as
    :class:`~bgpo_trl.objectives.stacked.TwinCriticLoss` says. Reads what `DDPGLoss` reads, writes
    ``"td_error"`` ``[*S, *B]``, the larger of the two squared errors, into the input, and returns,
    without a batch size,

    - ``"loss_actor"``, ``"loss_qvalue"`` ``[]``: to be added and differentiated;
    - ``"pred_value"`` ``[*S, 2, *B]``, ``"target_value"`` ``[*S, *B]``;
    - ``"td_error_max"``, ``"pre_tanh_magnitude"`` ``[*S]``.

    Args:
        actor_network: policy; its ``batch_size``, if it has one, is taken as ``S``. It must write
            ``"pre_tanh_action"`` unless ``pre_tanh_penalty`` is 0.
        qvalue_network: both Q-functions, ``batch_size`` ``[*S, 2]``.
        policy_noise: standard deviation of the noise on the target action.
        noise_clip: largest such noise.
        return_bounds: lowest and highest attainable return; ``None`` for no clipping.
        pre_tanh_penalty: weight of the penalty, 0 for none.
        constant_keys: as in `DDPGLoss`.
        loss_function: ``"l2"``, ``"l1"`` or ``"smooth_l1"``, of prediction and target.
        generator: of the noise, one a seed; ``None`` draws from torch's default generator.

    Raises:
        ValueError: if ``return_bounds`` is not an increasing pair, a number is negative, or batch
            sizes or generators do not fit together.

    Examples:
        >>> from bgpo_trl.modules.actor_critic import Actor, Critic
        >>> actor = Actor(6, 4, in_keys=["state"], batch_size=(10,))
        >>> loss = TD3Loss(actor, Critic(6, 4, in_keys=["state"], batch_size=(10, 2)))
        >>> loss.make_value_estimator(gamma=0.95)
    """

    @dataclass
    class _AcceptedKeys(objectives.TD3Loss._AcceptedKeys):
        """Names of the entries, to be changed with ``set_keys``.

        Attributes:
            pre_tanh_action: what the actor wrote before its tanh.
        """

        pre_tanh_action: NestedKey = "pre_tanh_action"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    def __init__(
        self,
        actor_network: TensorDictModuleBase,
        qvalue_network: TensorDictModuleBase,
        *,
        policy_noise: float = 0.2,
        noise_clip: float = 0.5,
        return_bounds: tuple[float, float] | None = None,
        pre_tanh_penalty: float = 0.01,
        constant_keys: Sequence[NestedKey] = (),
        loss_function: str = "l2",
        generator: torch.Generator | Sequence[torch.Generator] | None = None,
    ) -> None:
        if not (policy_noise >= 0 and noise_clip >= 0):
            raise ValueError(
                f"policy_noise and noise_clip must be >= 0, got {policy_noise} and {noise_clip}"
            )
        super().__init__(
            actor_network,  # pyright: ignore[reportArgumentType] narrower there than it need be
            qvalue_network,  # pyright: ignore[reportArgumentType]
            bounds=(-1.0, 1.0),  # pyright: ignore[reportArgumentType]
            num_qvalue_nets=0,  # none to be made: both are there
            policy_noise=policy_noise,
            noise_clip=noise_clip,
            loss_function=loss_function,
        )
        self._stack_twins(
            *(actor_network, qvalue_network, return_bounds, constant_keys, generator),
            pre_tanh_penalty=pre_tanh_penalty,
        )

    @dispatch()
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Compute both losses; reads, writes and returns what the class says."""
        loss_qvalue, told = self.value_loss(tensordict)
        loss_actor, told_of_actor = self.actor_loss(tensordict)
        losses = {"loss_actor": loss_actor, "loss_qvalue": loss_qvalue}
        return TensorDict({**losses, **told, **told_of_actor})

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute the actor's loss; reads what the class says.

        Args:
            tensordict: a batch of transitions ``[*S, *B]``.

        Returns:
            The loss ``[]`` and the diagnostics of the actor.

        Raises:
            ValueError: if the actor wrote no ``"pre_tanh_action"`` to penalize.
        """
        data = self._actor(self._select(tensordict, [*self.moving_keys, *self.constant_keys]))
        value = self._twin_values(self._frozen_critic, data).select(len(self.batch_size), 0)
        return self._penalized(value, data, tensordict)

    def value_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute the critics' loss; reads and writes what the class says.

        Args:
            tensordict: a batch of transitions ``[*S, *B]``.

        Returns:
            The loss ``[]`` and the diagnostics of the critics.

        Raises:
            ValueError: if the batch has no ``("next", "terminated")``.
        """
        with torch.no_grad():
            target = self._target(tensordict)
        return self._critics_loss(tensordict, target)

    def _target(self, tensordict: TensorDictBase) -> Tensor:
        data = self._target_actor(self._successor(tensordict))
        action = data.get(self.tensor_keys.action)
        noise = (self._normal(action) * self.policy_noise).clamp(-self.noise_clip, self.noise_clip)
        data.set(self.tensor_keys.action, (action + noise).clamp(-1.0, 1.0))
        next_value = self._twin_values(self._target_critic, data).amin(len(self.batch_size))
        return self._bootstrapped(tensordict, next_value.unsqueeze(-1))
