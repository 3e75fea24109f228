"""SAC for sparse rewards and stacked seeds: TorchRL's loss, with noise of each seed's own."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import Tensor, nn
from torchrl import objectives

from bgpo_trl.objectives.stacked import TwinCriticLoss

__all__ = ["SACLoss"]


class SACLoss(TwinCriticLoss, objectives.SACLoss):
    """SAC loss (Haarnoja et al., 2018b) for one seed or a stack of seeds.

    1. Target: ``r + gamma * (min_i Q_i'(s', a') - alpha * log pi(a' | s'))`` with ``a'`` drawn from
       the policy, clipped to ``return_bounds``. Without ``entropy_in_target`` its second term is
       left out: the Q-functions are then of the reward alone, to which the bounds belong, and
       entropy counts in the actor's loss only (Ball et al., 2023, for sparse rewards).
    2. The actor minimizes ``alpha * log pi(a | s) - min_i Q_i(s, a)``.
    3. The temperature ``alpha`` of each seed grows while the policy's entropy is below
       ``target_entropy``, and shrinks while it is above.

    It differs from :class:`torchrl.objectives.SACLoss` as
    :class:`~bgpo_trl.objectives.stacked.TwinCriticLoss` says, and by a temperature for each seed.
    Reads what `DDPGLoss` reads, writes ``"td_error"`` ``[*S, *B]``, the larger of the two squared
    errors, into the input, and returns, without a batch size,

    - ``"loss_actor"``, ``"loss_qvalue"``, ``"loss_alpha"`` ``[]``: to be added and differentiated;
    - ``"pred_value"`` ``[*S, 2, *B]``, ``"target_value"`` ``[*S, *B]``;
    - ``"td_error_max"``, ``"alpha"``, ``"entropy"`` ``[*S]``.

    Args:
        actor_network: a :class:`~bgpo_trl.modules.gaussian_actor.GaussianActor`, or what has its
            ``sample``; its ``batch_size``, if it has one, is taken as ``S``.
        qvalue_network: both Q-functions, ``batch_size`` ``[*S, 2]``.
        alpha_init: first temperature.
        target_entropy: of the policy, in nats over all action dimensions.
        entropy_in_target: whether the Q-functions count entropy to come.
        return_bounds: lowest and highest attainable return; ``None`` for no clipping.
        constant_keys: as in `DDPGLoss`.
        loss_function: ``"l2"``, ``"l1"`` or ``"smooth_l1"``, of prediction and target.
        generator: of the samples, one a seed; ``None`` draws from torch's default generator.

    Raises:
        ValueError: if ``return_bounds`` is not an increasing pair, ``alpha_init`` is not positive,
            or batch sizes or generators do not fit together.

    Examples:
        >>> from bgpo_trl.modules.actor_critic import Critic
        >>> from bgpo_trl.modules.gaussian_actor import GaussianActor
        >>> actor = GaussianActor(6, 4, in_keys=["state"], batch_size=(10,))
        >>> loss = SACLoss(actor, Critic(6, 4, in_keys=["state"], batch_size=(10, 2)))
        >>> loss.make_value_estimator(gamma=0.95)
        >>> loss.log_alpha.shape
        torch.Size([10])
    """

    log_alpha: nn.Parameter

    def __init__(
        self,
        actor_network: TensorDictModuleBase,
        qvalue_network: TensorDictModuleBase,
        *,
        alpha_init: float = 0.1,
        target_entropy: float = -4.0,
        entropy_in_target: bool = True,
        return_bounds: tuple[float, float] | None = None,
        constant_keys: Sequence[NestedKey] = (),
        loss_function: str = "l2",
        generator: torch.Generator | Sequence[torch.Generator] | None = None,
    ) -> None:
        if not (alpha_init > 0 and math.isfinite(alpha_init)):
            raise ValueError(f"alpha_init must be a number > 0, got {alpha_init}")
        super().__init__(
            actor_network,  # pyright: ignore[reportArgumentType] narrower there than it need be
            qvalue_network,  # pyright: ignore[reportArgumentType]
            num_qvalue_nets=0,  # none to be made: both are there
            loss_function=loss_function,
            alpha_init=alpha_init,
            target_entropy=target_entropy,
        )
        self._stack_twins(actor_network, qvalue_network, return_bounds, constant_keys, generator)
        self.entropy_in_target = entropy_in_target
        start = self.log_alpha.detach()
        self.log_alpha = nn.Parameter(start.expand(self.batch_size).clone())

    @dispatch()
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Compute all three losses; reads, writes and returns what the class says."""
        loss_qvalue, told = self.qvalue_v2_loss(tensordict)
        loss_actor, told_of_actor = self.actor_loss(tensordict)
        log_prob = told_of_actor["log_prob"]
        losses = {"loss_actor": loss_actor, "loss_qvalue": loss_qvalue}
        losses["loss_alpha"] = self._mean_per_seed(self._alpha_loss(log_prob), tensordict).sum()
        entropy = -self._flatten_batch(log_prob).mean(-1)
        return TensorDict({**losses, **told, "alpha": self._alpha, "entropy": entropy})

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute the actor's loss; reads what the class says.

        Args:
            tensordict: a batch of transitions ``[*S, *B]``.

        Returns:
            The loss ``[]`` and ``"log_prob"`` ``[*S, *B]`` of the actions drawn.
        """
        data = self._select(tensordict, [*self.moving_keys, *self.constant_keys])
        data, log_prob = self._sample(data)
        value = self._twin_values(self._frozen_critic, data).amin(len(self.batch_size))
        loss = self._mean_per_seed(self._each(self._alpha, log_prob) * log_prob - value, tensordict)
        return loss.sum(), {"log_prob": log_prob.detach()}

    def qvalue_v2_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute the critics' loss; reads and writes what the class says.

        Args:
            tensordict: a batch of transitions ``[*S, *B]``.

        Returns:
            The loss ``[]`` and the diagnostics of the critics.

        Raises:
            ValueError: if the batch has no ``("next", "terminated")``.
        """
        with torch.no_grad():
            target = self._compute_target_v2(tensordict)
        return self._critics_loss(tensordict, target)

    def _compute_target_v2(self, tensordict: TensorDictBase) -> Tensor:
        data, log_prob = self._sample(self._successor(tensordict))
        value = self._twin_values(self._target_critic, data).amin(len(self.batch_size))
        if self.entropy_in_target:
            value = value - self._each(self._alpha, log_prob) * log_prob
        return self._bootstrapped(tensordict, value.unsqueeze(-1))

    def _alpha_loss(self, log_prob: Tensor) -> Tensor:
        target: Any = self.target_entropy  # a number, in one type or another
        return -self._each(self.log_alpha, log_prob) * (log_prob + target)

    def _sample(self, data: TensorDictBase) -> tuple[TensorDictBase, Tensor]:
        """Return the data with actions of the policy, and their log-probabilities ``[*S, *B]``."""
        like = data.get(self.moving_keys[0])
        noise = self._normal(like.new_empty(*data.batch_size, self.actor_network.action_dim))
        data = self._actor.sample(data, noise)
        return data, data.get(self.tensor_keys.log_prob)

    def _each(self, of_seed: Tensor, like: Tensor) -> Tensor:
        """Return values of the seeds ``[*S]`` in a shape that goes with ``[*S, *B]``."""
        return of_seed.reshape(*self.batch_size, *[1] * (like.ndim - len(self.batch_size)))
