"""DDPG for sparse rewards and stacked seeds: TorchRL's loss with two remedies for divergence."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl import objectives
from torchrl.objectives import LossModule
from torchrl.objectives.utils import distance_loss

from bgpo_trl.objectives.stacked import StackedLoss

__all__ = ["DDPGLoss", "ForeachSoftUpdate"]


class DDPGLoss(StackedLoss, objectives.DDPGLoss):
    """DDPG loss (Lillicrap et al., 2016; Eq. 8 of the paper) for one seed or a stack of seeds.

    It differs from :class:`torchrl.objectives.DDPGLoss` in this:

    1. The bootstrapped target ``r + gamma * Q'(s', pi'(s'))`` is clipped to ``return_bounds``, if
       they are given: the range of attainable returns. With an extrinsic reward of 0 or 1 that ends
       the episode and an intrinsic reward of at most ``beta`` that range is ``[0, 1 + beta]``.
    2. ``pre_tanh_penalty * mean(pre_tanh_action ** 2)``, the mean over batch and action dimensions,
       is added to the actor's loss, so that the tanh does not saturate.
    3. Losses are a mean over the batch and a *sum* over the actor's leading ``batch_size``, so that
       the gradient of each seed is what it would have alone.
    4. Actor and critic have target networks, ``gamma`` is 0.98, and an entry that is constant
       within an episode need not be stored a second time under ``"next"``.

    Without 1 and 2 DDPG diverges on these tasks: Q grows to hundreds and every action saturates.
    Only ``"terminated"`` ends the bootstrap; a truncated episode goes on.

    Reads the ``in_keys`` of both networks (``"action"`` ``[*S, *B, action_dim]`` among them), those
    of the actor under ``"next"``, and ``("next", "reward")``, ``("next", "terminated")``
    ``[*S, *B, 1]`` (``("next", "done")`` is not needed). Writes ``"td_error"`` ``[*S, *B]``, the
    squared error that prioritized replay wants, into the input. Returns, without a batch size,

    - ``"loss_actor"``, ``"loss_value"`` ``[]``: to be added and differentiated;
    - ``"pred_value"``, ``"target_value"`` ``[*S, *B]``: Q and its target;
    - ``"pred_value_max"``, ``"target_value_max"``, ``"td_error_max"`` ``[*S]``: over the batch;
    - ``"pre_tanh_magnitude"`` ``[*S]``: root mean square of the actor's output before tanh.

    Args:
        actor_network: policy; its ``batch_size``, if it has one, is taken as ``S``. It must write
            ``"pre_tanh_action"`` unless ``pre_tanh_penalty`` is 0.
        value_network: Q-function.
        return_bounds: lowest and highest attainable return; ``None`` for no clipping.
        pre_tanh_penalty: weight of the penalty, 0 for none.
        constant_keys: entries of the networks' input that are constant within an episode: their
            next value is read from the root.
        loss_function: ``"l2"``, ``"l1"`` or ``"smooth_l1"``, of prediction and target.
        delay_actor: whether the target action comes from a target network.
        delay_value: whether the target value comes from a target network.

    Raises:
        ValueError: if ``return_bounds`` is not an increasing pair, the penalty is negative, or
            there is no such ``loss_function``.

    Examples:
        >>> from tensordict import TensorDict
        >>> from bgpo_trl.modules.actor_critic import Actor, Critic
        >>> seeds = {"in_keys": ["state"], "batch_size": (10,)}
        >>> loss = DDPGLoss(Actor(6, 4, **seeds), Critic(6, 4, **seeds))
        >>> target_update = ForeachSoftUpdate(loss, tau=0.005)
        >>> shape = (10, 256)
        >>> batch = TensorDict({
        ...     "state": torch.randn(*shape, 6),
        ...     "action": torch.rand(*shape, 4) * 2 - 1,
        ...     "next": {
        ...         "state": torch.randn(*shape, 6),
        ...         "reward": torch.zeros(*shape, 1),
        ...         "done": torch.zeros(*shape, 1, dtype=torch.bool),
        ...         "terminated": torch.zeros(*shape, 1, dtype=torch.bool),
        ...     },
        ... }, shape)
        >>> losses = loss(batch)
        >>> (losses["loss_actor"] + losses["loss_value"]).backward()
        >>> losses["td_error_max"].shape
        torch.Size([10])
    """

    @dataclass
    class _AcceptedKeys(objectives.DDPGLoss._AcceptedKeys):
        """Names of the entries, to be changed with ``set_keys``.

        Attributes:
            pre_tanh_action: what the actor wrote before its tanh.
        """

        pre_tanh_action: NestedKey = "pre_tanh_action"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys: ClassVar = [
        *("loss_actor", "loss_value", "pred_value", "target_value"),
        *("pred_value_max", "target_value_max", "td_error_max", "pre_tanh_magnitude"),
    ]

    def __init__(
        self,
        actor_network: TensorDictModuleBase,
        value_network: TensorDictModuleBase,
        *,
        return_bounds: tuple[float, float] | None = None,
        pre_tanh_penalty: float = 0.01,
        constant_keys: Sequence[NestedKey] = (),
        loss_function: str = "l2",
        delay_actor: bool = True,
        delay_value: bool = True,
    ) -> None:
        super().__init__(
            actor_network,  # pyright: ignore[reportArgumentType] narrower there than it need be
            value_network,  # pyright: ignore[reportArgumentType]
            loss_function=loss_function,
            delay_actor=delay_actor,
            delay_value=delay_value,
        )
        self._stack(actor_network, return_bounds, constant_keys, pre_tanh_penalty)

    def loss_value(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute the critic's loss; reads and writes what the class says.

        Args:
            tensordict: a batch of transitions ``[*S, *B]``.

        Returns:
            The loss ``[]`` and the diagnostics of the critic.

        Raises:
            ValueError: if the batch lacks an entry, or the reward has another shape.
        """
        data = self._select(tensordict, self.value_network.in_keys)
        self._critic(data)
        prediction = data.get(self.tensor_keys.state_action_value).squeeze(-1)
        with torch.no_grad():
            target = self._target(tensordict)
        distance = distance_loss(prediction, target, self.loss_function)
        prediction = prediction.detach()
        td_error = (prediction - target).square()
        tensordict.set(self.tensor_keys.priority, td_error)
        return self._mean_per_seed(distance, tensordict).sum(), {
            "pred_value": prediction,
            "target_value": target,
            "pred_value_max": self._flatten_batch(prediction).amax(-1),
            "target_value_max": self._flatten_batch(target).amax(-1),
            "td_error_max": self._flatten_batch(td_error).amax(-1),
        }

    def loss_actor(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute the actor's loss; reads what the class says.

        Args:
            tensordict: a batch of transitions ``[*S, *B]``.

        Returns:
            The loss ``[]`` and the diagnostics of the actor.

        Raises:
            ValueError: if the batch lacks an entry, or the actor wrote no ``"pre_tanh_action"`` to
                penalize.
        """
        data = self._select(tensordict, [*self.actor_in_keys, *self.value_exclusive_keys])
        self._frozen_critic(self._actor(data))
        value = data.get(self.tensor_keys.state_action_value).squeeze(-1)
        return self._penalized(value, data, tensordict)

    def _target(self, tensordict: TensorDictBase) -> Tensor:
        data = self._successor(tensordict)
        self._target_critic(self._target_actor(data))
        next_value = data.get(self.tensor_keys.state_action_value)
        return self._bootstrapped(tensordict, next_value)


def _float_pairs(
    targets: TensorDictBase, sources: TensorDictBase
) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield each target with its source, where they are tensors of their own."""
    for key, target in targets.items(True, True):
        source = sources[key]
        if target.is_floating_point() and not target.is_set_to(source.data):
            yield target, source


class ForeachSoftUpdate(objectives.SoftUpdate):
    """TorchRL's :class:`~torchrl.objectives.SoftUpdate` of target networks, in one kernel call.

    Takes 0.02 ms an update in place of 0.33 ms for one actor and critic of 64 hidden units. Targets
    also follow what needs no gradient, which TorchRL's do not: in `MAMLLoss` the adapted policies.

    Args:
        loss_module: loss with target networks.
        eps: share of the target that is kept, ``1 - tau``; exclusive with ``tau``.
        tau: share of the source that is taken over (Polyak averaging).

    Raises:
        ValueError: if not one of ``eps`` and ``tau`` is given, or targets would never move.
    """

    def __init__(
        self, loss_module: LossModule, *, eps: float | None = None, tau: float | None = None
    ) -> None:
        kept = eps if tau is None else 1 - tau
        if (eps is not None and tau is not None) or kept is None or not 0 <= kept < 1:
            raise ValueError(f"give tau in (0, 1], or eps in [0, 1), got tau={tau}, eps={eps}")
        super().__init__(loss_module, eps=eps, tau=tau)
        pairs = [
            (target, source)
            for name in self._target_names
            for target, source in _float_pairs(
                getattr(loss_module, name), getattr(loss_module, name.removeprefix("target_"))
            )
        ]
        self._target_tensors, self._source_tensors = map(list, zip(*pairs, strict=True))

    @torch.no_grad()
    def step(self) -> None:
        """Move each target towards its source: ``target <- eps * target + (1 - eps) * source``."""
        torch._foreach_lerp_(  # pyright: ignore[reportPrivateImportUsage] as torch.optim does
            self._target_tensors, self._source_tensors, 1 - self.eps
        )
