"""What the losses of all RL algorithms share: stacked seeds, attainable targets, twin critics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import deepcopy
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.objectives import ValueEstimators
from torchrl.objectives.utils import _cache_values, distance_loss

from bgpo_trl.errors import missing_key
from bgpo_trl.seeding import normal

__all__ = ["StackedLoss", "TwinCriticLoss"]

if TYPE_CHECKING:
    from torchrl.objectives import LossModule
else:
    # Every class derived from LossModule gets a `forward` of its own, which would stand before that
    # of TorchRL's losses.
    LossModule = object


class StackedLoss(LossModule):
    """Base of losses of an actor and its critics for one seed or a stack of seeds ``S``.

    Goes before TorchRL's loss among the bases of a class. A loss is a mean over the batch and a
    *sum* over the actor's leading ``batch_size``, so that the gradient of each seed is what it
    would have alone. Bootstrapped targets are clipped to ``return_bounds``, if they are given.
    An entry that is constant within an episode need not be stored a second time under ``"next"``.
    Only ``"terminated"`` ends the bootstrap; a truncated episode goes on.
    """

    # The other estimators need whole trajectories, and replay serves single transitions.
    SUPPORTED_VALUE_ESTIMATORS = (ValueEstimators.TD0,)
    _critic_name: ClassVar[str] = "value_network"

    actor_network: Any
    tensor_keys: Any
    loss_function: str
    batch_size: torch.Size
    return_bounds: tuple[float, float] | None
    pre_tanh_penalty: float

    def _stack(
        self,
        actor_network: TensorDictModuleBase,
        return_bounds: tuple[float, float] | None,
        constant_keys: Sequence[NestedKey],
        pre_tanh_penalty: float = 0.0,
    ) -> None:
        """Takes over what is common to all losses; called at the end of each constructor.

        Raises:
            ValueError: if ``return_bounds`` is not an increasing pair, the penalty is negative, or
                there is no such ``loss_function``.
        """
        if not (pre_tanh_penalty >= 0 and math.isfinite(pre_tanh_penalty)):
            raise ValueError(f"pre_tanh_penalty must be a number >= 0, got {pre_tanh_penalty}")
        self.pre_tanh_penalty = pre_tanh_penalty
        if return_bounds is not None and not return_bounds[0] < return_bounds[1]:
            raise ValueError(f"return_bounds must be (low, high) with low < high: {return_bounds}")
        if self.loss_function not in ("l2", "l1", "smooth_l1"):
            raise ValueError(
                f"loss_function must be l2, l1 or smooth_l1, got {self.loss_function!r}"
            )
        self.return_bounds = return_bounds
        self.batch_size = torch.Size(getattr(actor_network, "batch_size", ()))
        critic_keys = set(getattr(self, self._critic_name).in_keys)
        input_keys = {*actor_network.in_keys, *critic_keys.difference(actor_network.out_keys)}
        self.constant_keys = [key for key in constant_keys if key in input_keys]
        self.moving_keys = list(input_keys.difference(constant_keys))

    def make_value_estimator(
        self, value_type: ValueEstimators | None = None, **hyperparams
    ) -> None:
        """Sets the estimator of the target.

        Args:
            value_type: ``ValueEstimators.TD0`` or a value estimator of TorchRL.
            **hyperparams: such as ``gamma``, 0.98 by default (the paper gives none).

        Raises:
            ValueError: if gamma does not lie in [0, 1].
        """
        if not 0 <= hyperparams.get("gamma", 0.98) <= 1:
            raise ValueError(f"gamma must be between 0 and 1, got {hyperparams['gamma']}")
        value_type = value_type or self.default_value_estimator
        super().make_value_estimator(value_type, **{"gamma": 0.98, **hyperparams})

    def _successor(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Returns what the networks read of the next states.

        Raises:
            ValueError: if the batch lacks an entry.
        """
        name = type(self).__name__
        successor = tensordict.get("next", None)
        if successor is None or successor.get(self.tensor_keys.reward, None) is None:
            raise missing_key(name, tensordict, [("next", self.tensor_keys.reward)])
        if successor.get(self.tensor_keys.terminated, None) is None:
            # The estimator would read "done" in its place, and stop at truncation too.
            raise ValueError(
                f"the batch lacks ('next', {self.tensor_keys.terminated!r}): store it, since only "
                "it tells a success from a time-out"
            )
        data = self._select(successor, self.moving_keys, f"{name}, under 'next',")
        for key in self.constant_keys:
            data.set(key, tensordict[key])
        return data

    def _select(
        self, tensordict: TensorDictBase, keys: Sequence[NestedKey], reader: str | None = None
    ) -> TensorDictBase:
        """Returns entries without their gradients.

        Raises:
            ValueError: if one is missing.
        """
        try:
            return tensordict.select(*keys).detach()
        except KeyError:
            raise missing_key(reader or type(self).__name__, tensordict, keys) from None

    def _bootstrapped(self, tensordict: TensorDictBase, next_value: Tensor) -> Tensor:
        """Returns the clipped target ``[*S, *B]`` for values ``[*S, *B, 1]`` of the next states.

        Raises:
            ValueError: if the reward has another shape.
        """
        reward = tensordict.get(("next", self.tensor_keys.reward))
        if reward.shape != next_value.shape:
            raise ValueError(
                f"the reward must be {[*next_value.shape]}, as the value is, got {[*reward.shape]}"
            )
        target = self.value_estimator.value_estimate(tensordict, next_value=next_value).squeeze(-1)
        return target if self.return_bounds is None else target.clamp(*self.return_bounds)

    def _penalized(
        self, value: Tensor, data: TensorDictBase, tensordict: TensorDictBase
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Returns the loss ``[]`` of an actor that ends in a tanh, and its diagnostics.

        ``-mean(value)``, and ``pre_tanh_penalty`` times the mean square of what was before the
        tanh, over batch and action dimensions, so that the tanh does not saturate.

        Args:
            value: of the actor's actions, ``[*S, *B]``.
            data: what the actor wrote.
            tensordict: the batch, with its weights if it has some.

        Raises:
            ValueError: if the actor wrote no ``"pre_tanh_action"`` to penalize.
        """
        loss = -self._mean_per_seed(value, tensordict)
        pre_tanh = data.get(self.tensor_keys.pre_tanh_action, None)
        if pre_tanh is None:
            if self.pre_tanh_penalty:
                raise ValueError(
                    f"the actor wrote no {self.tensor_keys.pre_tanh_action!r} to penalize: write "
                    "it, name it with set_keys(pre_tanh_action=...), or pass pre_tanh_penalty=0"
                )
            return loss.sum(), {}
        square = pre_tanh.square()
        if self.pre_tanh_penalty:
            weights = self._maybe_get_priority_weight(tensordict)
            weighted = square if weights is None else square * weights.unsqueeze(-1)
            loss = loss + self.pre_tanh_penalty * self._flatten_batch(weighted).mean(-1)
        magnitude = self._flatten_batch(square.detach()).mean(-1).sqrt()
        return loss.sum(), {"pre_tanh_magnitude": magnitude}

    # The networks with parameters in place: TorchRL's way of putting them in for each call takes
    # 0.14 ms, four times an update. As other cached values, they are made anew after a cast.

    @property
    @_cache_values
    def _actor(self) -> Any:
        return self._bind("actor_network")

    @property
    @_cache_values
    def _critic(self) -> Any:
        return self._bind(self._critic_name)

    @property
    @_cache_values
    def _frozen_critic(self) -> Any:
        return self._bind(self._critic_name, detach=True)

    @property
    @_cache_values
    def _target_actor(self) -> Any:
        return self._bind("actor_network", "target_")

    @property
    @_cache_values
    def _target_critic(self) -> Any:
        return self._bind(self._critic_name, "target_")

    def _bind(self, name: str, prefix: str = "", *, detach: bool = False) -> Any:
        """Returns a copy of a network that holds these very parameters."""
        network = deepcopy(getattr(self, name))
        params = getattr(self, f"{prefix}{name}_params")
        (params.detach() if detach else params).to_module(network)
        return network

    def __getstate__(self) -> dict[str, Any]:
        # A copy makes its own: copies of detached tensors would no longer follow the parameters.
        return {**super().__getstate__(), "_cache": {}}

    def _mean_per_seed(self, loss: Tensor, tensordict: TensorDictBase) -> Tensor:
        weights = self._maybe_get_priority_weight(tensordict)
        loss = self._reduce_loss(loss, tensordict, reduction="none", weights=weights)
        return self._flatten_batch(loss).mean(-1)

    def _flatten_batch(self, values: Tensor) -> Tensor:
        return values.reshape(*self.batch_size, -1)


class TwinCriticLoss(StackedLoss):
    """Base of losses with two Q-functions, of which the smaller is believed, and noise of its own.

    The Q-functions are one network whose ``batch_size`` is ``[*S, 2]``. TorchRL's losses make two
    of one by drawing the weights of both anew, and draw their noise, from PyTorch's global
    generator: seeds would not be what they are alone, nor a resumed run what it would have been.
    Here noise comes from the seeds' own generators, whose states are in the ``state_dict``.
    """

    _critic_name = "qvalue_network"

    def _stack_twins(
        self,
        actor_network: TensorDictModuleBase,
        qvalue_network: TensorDictModuleBase,
        return_bounds: tuple[float, float] | None,
        constant_keys: Sequence[NestedKey],
        generator: torch.Generator | Sequence[torch.Generator] | None,
        pre_tanh_penalty: float = 0.0,
    ) -> None:
        """Takes over what is common to all losses; called at the end of each constructor.

        Raises:
            ValueError: if the batch sizes or the number of generators do not fit together.
        """
        self._stack(actor_network, return_bounds, constant_keys, pre_tanh_penalty)
        critics = torch.Size(getattr(qvalue_network, "batch_size", ()))
        if critics != (*self.batch_size, 2):
            raise ValueError(
                "qvalue_network must hold two Q-functions for each actor, batch_size "
                f"{[*self.batch_size, 2]}, got {[*critics]}"
            )
        self.generators: list[torch.Generator] = []
        if isinstance(generator, torch.Generator):
            self.generators = [generator]
        elif generator is not None:
            self.generators = list(generator)
            if len(self.generators) != self.batch_size.numel():
                raise ValueError(
                    f"pass one generator a seed: {self.batch_size.numel()} are needed, got "
                    f"{len(self.generators)}"
                )

    def _normal(self, like: Tensor) -> Tensor:
        """Returns standard normals of the shape of ``like``, ``[*S, ...]``."""
        if len(self.generators) < 2:
            drawn = torch.randn(like.shape, generator=next(iter(self.generators), None))
        else:
            drawn = normal(self.generators, like.shape[len(self.batch_size) :]).view(like.shape)
        return drawn.to(like)

    def _twin_values(self, critic: Any, data: TensorDictBase) -> Tensor:
        """Returns what both Q-functions say, ``[*S, 2, *B]``."""
        n_stacked = len(self.batch_size)
        data = data.select(*critic.in_keys).unsqueeze(n_stacked)
        shape = data.batch_size
        data = critic(data.expand(*shape[:n_stacked], 2, *shape[n_stacked + 1 :]))
        return data.get(self.tensor_keys.state_action_value).squeeze(-1)

    def _critics_loss(
        self, tensordict: TensorDictBase, target: Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Returns the sum of both critics' losses ``[]``, and what they said of the batch."""
        n_stacked = len(self.batch_size)
        prediction = self._twin_values(self._critic, tensordict.detach())
        targets = target.unsqueeze(n_stacked).expand_as(prediction)
        distance = distance_loss(prediction, targets, self.loss_function).sum(n_stacked)
        prediction = prediction.detach()
        td_error = (prediction - targets).square().amax(n_stacked)
        tensordict.set(self.tensor_keys.priority, td_error)
        return self._mean_per_seed(distance, tensordict).sum(), {
            "pred_value": prediction,
            "target_value": target,
            "td_error_max": self._flatten_batch(td_error).amax(-1),
        }

    def get_extra_state(self) -> Tensor:
        """Returns the states of the generators, for `state_dict`."""
        states = [generator.get_state() for generator in self.generators]
        return torch.stack(states) if states else torch.empty(0, dtype=torch.uint8)

    def set_extra_state(self, state: Tensor) -> None:
        """Continues the generators from what `get_extra_state` returned."""
        for generator, saved in zip(self.generators, state, strict=True):
            generator.set_state(saved.clone())  # a row of a tensor would crash it
