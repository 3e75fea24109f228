"""Base of off-policy actor-critic losses for a stack of seeds: targets, noise, slow networks."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictParams, dispatch
from torch import Tensor, nn
from torch.func import functional_call
from torch.optim.swa_utils import get_ema_multi_avg_fn
from torchrl.objectives import LossModule, SoftUpdate, ValueEstimators
from torchrl.objectives.value import TD0Estimator

from bgpo_trl.configs import RLConfig
from bgpo_trl.errors import missing_key
from bgpo_trl.seeding import normal

__all__ = ["ForeachSoftUpdate", "OffPolicyLoss", "SeededNoise", "TransitionKeys"]


class SeededNoise(nn.Module):
    """Standard normal noise for a stack of seeds, each from its own generator.

    TorchRL's losses draw from PyTorch's global generator, so that a seed of a stack would differ
    from that seed alone, and a resumed run from an uninterrupted one. The ``state_dict`` of this
    module, and of a loss that contains it, has the states of the generators.

    Args:
        batch_size: Leading dimensions ``S`` of the stack.
        generator: One generator for each index of ``S``, or a single one for all; ``None`` draws
            from torch's default generator, whose state is not saved.

    Raises:
        ValueError: If the number of generators is not that of the seeds.

    Examples:
        >>> noise = SeededNoise([2], [torch.Generator().manual_seed(seed) for seed in (3, 8)])
        >>> noise(torch.zeros(2, 128, 4)).shape
        torch.Size([2, 128, 4])
    """

    def __init__(
        self,
        batch_size: Sequence[int] = (),
        generator: torch.Generator | Sequence[torch.Generator] | None = None,
    ) -> None:
        super().__init__()
        self.batch_size = torch.Size(batch_size)
        one_for_all = isinstance(generator, torch.Generator)
        self.generators = [generator] if one_for_all else list(generator or ())
        if isinstance(generator, Sequence) and len(generator) != self.batch_size.numel():
            raise ValueError(
                f"pass one generator a seed: {self.batch_size.numel()} are needed, got "
                f"{len(generator)}"
            )

    def forward(self, like: Tensor) -> Tensor:
        """Return noise of the shape, dtype and device of ``like`` ``[*S, ...]``."""
        if len(self.generators) < 2:
            drawn = torch.randn(like.shape, generator=next(iter(self.generators), None))
        else:
            drawn = normal(self.generators, like.shape[len(self.batch_size) :]).view(like.shape)
        return drawn.to(like)

    def get(self, seed: int, expert: int) -> Tensor:
        """Return the state of a generator, in a batch ``[S, E]``."""
        return self.generators[seed * self.batch_size[1] + expert].get_state()

    def set(self, seed: int, expert: int, state: Tensor) -> None:
        """Restore the result of `get`."""
        self.generators[seed * self.batch_size[1] + expert].set_state(state.cpu())

    def resize(self, width: int) -> None:
        """Change ``E`` of a batch ``[S, E]``; generators that are added have yet to be `set`."""
        n_seeds, now = self.batch_size
        self.generators = [
            self.generators[seed * now + expert] if expert < now else torch.Generator()
            for seed in range(n_seeds)
            for expert in range(width)
        ]
        self.batch_size = torch.Size([n_seeds, width])

    def get_extra_state(self) -> Tensor:
        """Return the states of the generators, uint8 ``[number, bytes]``."""
        states = [generator.get_state() for generator in self.generators]
        return torch.stack(states) if states else torch.empty(0, dtype=torch.uint8)

    def set_extra_state(self, state: Tensor) -> None:
        """Restore the result of `get_extra_state`."""
        if len(state) != len(self.generators):
            raise ValueError(
                f"the state was saved with {len(state)} generators, this loss has "
                f"{len(self.generators)}: pass as many"
            )
        for generator, saved in zip(self.generators, state, strict=True):
            generator.set_state(saved.clone())  # set_state crashes on a view


@dataclass
class TransitionKeys:
    """Names of the entries of an off-policy loss, to be changed with its ``set_keys``."""

    action: NestedKey = "action"
    """Action of a transition, and of the actor."""
    pre_tanh_action: NestedKey = "pre_tanh_action"
    """Output of the actor before its tanh."""
    log_prob: NestedKey = "action_log_prob"
    """Log-probability of an action drawn from the actor."""
    state_action_value: NestedKey = "state_action_value"
    """Output of the critics."""
    reward: NestedKey = "reward"
    """Reward, under ``"next"``."""
    done: NestedKey = "done"
    """Whether the episode is over, under ``"next"``; accepted and not needed."""
    terminated: NestedKey = "terminated"
    """Whether nothing can follow, under ``"next"``: ends the bootstrap."""
    priority: NestedKey = "td_error"
    """Squared error of the critics, written for prioritized replay."""
    priority_weight: NestedKey = "priority_weight"
    """Factor of each transition's loss."""
    demonstrated: NestedKey = "demonstrated"
    """Whether the action is that of a demonstration."""


class OffPolicyLoss(LossModule):
    """Base of off-policy actor-critic losses for one seed or a stack of seeds ``S``.

    A subclass defines `next_value` and `loss_actor`, sets ``twin_critics`` if it has two critics,
    and lists in ``actor_keys`` the further entries that its `loss_actor` returns. The base

    1. regresses the critics to ``r + gamma * next_value``, clipped to ``return_bounds``. Only
       ``"terminated"`` ends the bootstrap; a truncated episode goes on;
    2. takes the mean of a loss over the batch and its *sum* over the actor's ``batch_size``, so
       that each seed has the gradient that it would have alone; with ``reduction="none"``, losses
       are those of each seed, to be summed by the caller;
    3. reads entries that are constant within an episode from the root, not from ``"next"``;
    4. sums the losses of twin critics, one network with the ``batch_size`` ``[*S, 2]``.

    Reads the ``in_keys`` of both networks, among them ``"action"`` ``[*S, *B, action_dim]``; under
    ``"next"`` those that are not constant, ``"reward"`` and ``"terminated"`` ``[*S, *B, 1]``; and,
    if present, ``"priority_weight"`` ``[*S, *B]``, a factor of each transition's loss, and
    ``"steps_to_next_obs"`` ``[*S, *B, 1]`` of TorchRL's ``MultiStep``, the power of gamma. Masks
    (``loss_mask_key``) are not read. Writes ``"td_error"`` ``[*S, *B]`` into the input, for
    prioritized replay: the squared error, the larger one of twin critics. Returns, without a batch
    size, the entries of `loss_actor` and

    - ``"loss_actor"``, ``"loss_value"`` ``[]``, or ``[*S]`` without reduction: to be added, with
      any other ``"loss_..."``;
    - ``"pred_value"`` ``[*S, *B]``, or ``[*S, 2, *B]`` of twin critics: values of the batch;
    - ``"target_value"`` ``[*S, *B]``: bootstrapped targets;
    - ``"pred_value_max"``, ``"target_value_max"``, ``"td_error_max"`` ``[*S]``: over the batch.

    Args:
        actor_network: Policy; its ``batch_size``, if it has one, is taken as ``S``.
        value_network: Q-function, or twin Q-functions.
        return_bounds: Lowest and highest attainable return; ``None`` for no clipping.
        pre_tanh_penalty: Weight of the penalty of `penalized`, 0 for none.
        imitation: Weight of `imitation_loss` in the actor's loss, 0 for none.
        constant_keys: Entries of the networks' input that are constant within an episode.
        delay_actor: Whether the actor has a target network, as the critics always have.
        reduction: ``"sum"`` over ``S``, or ``"none"``.

    Raises:
        ValueError: If ``return_bounds`` is not an increasing pair, the penalty is negative, there
            is no such ``reduction``, the critics' ``batch_size`` is not the
            actor's, or that of twin critics not ``[*S, 2]``;
            from ``forward``, if an entry is missing, or reward or weights have another shape.
    """

    tensor_keys: TransitionKeys
    default_keys = TransitionKeys
    _AcceptedKeys = TransitionKeys  # pyright: ignore[reportAssignmentType] each loss has its own
    # The other estimators need whole trajectories, and replay serves single transitions.
    default_value_estimator = ValueEstimators.TD0
    twin_critics: ClassVar[bool] = False
    actor_keys: ClassVar[Sequence[str]] = ()

    actor_network: Any
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams
    value_network: Any
    value_network_params: TensorDictParams
    target_value_network_params: TensorDictParams

    def __init__(
        self,
        actor_network: Any,  # a TensorDictModuleBase; TorchRL's methods ask for a TensorDictModule
        value_network: Any,
        *,
        return_bounds: tuple[float, float] | None = None,
        pre_tanh_penalty: float = 0.0,
        imitation: float = 0.0,
        constant_keys: Sequence[NestedKey] = (),
        delay_actor: bool = True,
        reduction: str = "sum",
    ) -> None:
        if not (pre_tanh_penalty >= 0 and math.isfinite(pre_tanh_penalty)):
            raise ValueError(f"pre_tanh_penalty must be a number >= 0, got {pre_tanh_penalty}")
        if not (imitation >= 0 and math.isfinite(imitation)):
            raise ValueError(f"imitation must be a number >= 0, got {imitation}")
        if return_bounds is not None and not return_bounds[0] < return_bounds[1]:
            raise ValueError(f"return_bounds must be (low, high) with low < high: {return_bounds}")
        if reduction not in ("sum", "none"):
            raise ValueError(f"reduction must be sum or none, got {reduction!r}")
        super().__init__()
        self.noise: SeededNoise | None = None
        self.batch_size = torch.Size(getattr(actor_network, "batch_size", ()))
        critics = torch.Size(getattr(value_network, "batch_size", ()))
        wanted = (*self.batch_size, 2) if self.twin_critics else self.batch_size
        # A single Q-function without a batch size may be any module.
        if critics != wanted and (self.twin_critics or critics):
            raise ValueError(
                f"value_network must hold {'two Q-functions' if self.twin_critics else 'one'} for "
                f"each actor, batch_size {[*wanted]}, got {[*critics]}: a network in a container "
                "such as TensorDictSequential has none"
            )
        self.convert_to_functional(actor_network, "actor_network", create_target_params=delay_actor)
        self.convert_to_functional(value_network, "value_network", create_target_params=True)
        self.return_bounds, self.pre_tanh_penalty = return_bounds, pre_tanh_penalty
        self.imitation, self.reduction = imitation, reduction
        written = set(actor_network.out_keys)
        read = [*actor_network.in_keys, *(k for k in value_network.in_keys if k not in written)]
        self.input_keys = [*dict.fromkeys(unravel_key(key) for key in read)]
        self.constant_keys = [unravel_key(key) for key in constant_keys]
        unknown = [key for key in self.constant_keys if key not in self.input_keys]
        if unknown:
            raise ValueError(f"constant_keys must be among {self.input_keys}, got {unknown}")

    @property
    def in_keys(self) -> list[NestedKey]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Entries that `forward` accepts."""
        keys = self.tensor_keys
        read = [*self.input_keys, *self.value_network.in_keys, keys.priority_weight]
        following = [*self.input_keys, keys.reward, keys.done, keys.terminated]
        return [*dict.fromkeys(read), *(unravel_key(("next", key)) for key in following)]

    @property
    def out_keys(self) -> list[NestedKey]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Entries that `forward` returns."""
        of_value = ["pred_value", "target_value", "pred_value_max", "target_value_max"]
        of_actor = list(self.actor_keys)
        # `penalized` returns no magnitude for an actor that does not write this entry.
        if self.tensor_keys.pre_tanh_action not in self.actor_network.out_keys:
            of_actor = [key for key in of_actor if key != "pre_tanh_magnitude"]
        return ["loss_actor", "loss_value", *of_value, "td_error_max", *of_actor]

    def make_value_estimator(self, value_type: Any = None, **hyperparams: Any) -> None:
        """Set the estimator of the target.

        Args:
            value_type: ``ValueEstimators.TD0`` or a value estimator of TorchRL.
            **hyperparams: Arguments of the estimator; ``gamma`` is `RLConfig.gamma` by default.

        Raises:
            ValueError: If gamma does not lie in [0, 1].
            NotImplementedError: If the estimator is another one of ``ValueEstimators``.
        """
        hyperparams = {"gamma": RLConfig.gamma, "value_network": None, **hyperparams}
        if not 0 <= hyperparams["gamma"] <= 1:
            raise ValueError(f"gamma must be between 0 and 1, got {hyperparams['gamma']}")
        if value_type is None or value_type == ValueEstimators.TD0:
            value_type = TD0Estimator
        elif isinstance(value_type, ValueEstimators):
            raise NotImplementedError(f"{value_type} needs whole trajectories: choose TD0")
        super().make_value_estimator(value_type, **hyperparams)
        self.set_keys()  # the names of the entries, to the estimator too

    @dispatch()
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Compute all losses of a batch of transitions ``[*S, *B]``; see the class."""
        loss_value, of_value = self.loss_value(tensordict)
        loss_actor, of_actor = self.loss_actor(tensordict)
        losses = {"loss_actor": loss_actor, "loss_value": loss_value}
        return TensorDict({**losses, **of_value, **of_actor})

    def next_value(self, successor: TensorDictBase) -> Tensor:
        """Return the values ``[*S, *B]`` of the input at next states; called without gradients."""
        raise NotImplementedError

    def loss_actor(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute the actor's loss, reduced, and further entries for the result of `forward`."""
        raise NotImplementedError

    def loss_value(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute the critics' loss, reduced, and their further entries; write ``"td_error"``."""
        with torch.no_grad():
            target = self.target(tensordict)
        data = self._select(tensordict, self.value_network.in_keys)
        prediction = self.values("value_network", data)
        twin_dim = len(self.batch_size)
        of_each = target.unsqueeze(twin_dim).expand_as(prediction) if self.twin_critics else target
        distance = torch.nn.functional.mse_loss(prediction, of_each, reduction="none")
        prediction, td_error = prediction.detach(), distance.detach()
        if self.twin_critics:
            distance, td_error = distance.sum(twin_dim), td_error.amax(twin_dim)
        tensordict.set(self.tensor_keys.priority, td_error)
        return self.reduce(distance, tensordict), {
            "pred_value": prediction,
            "target_value": target,
            "pred_value_max": self.flatten_batch(prediction).amax(-1),
            "target_value_max": self.flatten_batch(target).amax(-1),
            "td_error_max": self.flatten_batch(td_error).amax(-1),
        }

    def target(self, tensordict: TensorDictBase) -> Tensor:
        """Return the clipped bootstrapped targets of transitions, ``[*S, *B]``."""
        successor = self.following(tensordict)
        next_value = self.next_value(successor).unsqueeze(-1)
        reward = tensordict.get(("next", self.tensor_keys.reward))
        if reward.shape != next_value.shape:
            raise ValueError(
                f"the reward must be {[*next_value.shape]}, as the value is, got {[*reward.shape]}"
            )
        target = self.value_estimator.value_estimate(tensordict, next_value=next_value).squeeze(-1)
        return target if self.return_bounds is None else target.clamp(*self.return_bounds)

    def current(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the networks' input, detached, in the states of transitions ``[*S, *B]``."""
        return self._select(tensordict, self.input_keys)

    def following(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the networks' input, detached, in the next states of transitions ``[*S, *B]``.

        Raises:
            ValueError: If the reward, the termination or an entry is missing under ``"next"``.
        """
        names, successor = self.tensor_keys, tensordict.get("next", None)
        if successor is None or successor.get(names.reward, None) is None:
            raise missing_key(type(self).__name__, tensordict, [("next", names.reward)])
        if successor.get(names.terminated, None) is None:
            # The estimator would read "done" in its place, and stop at truncation too.
            raise ValueError(
                f"the batch lacks ('next', {names.terminated!r}): store it, since only it "
                "distinguishes a success from a time-out"
            )
        moving = [key for key in self.input_keys if key not in self.constant_keys]
        data = self._select(successor, moving, ", under 'next',")
        for key in self.constant_keys:
            data.set(key, tensordict[key])
        return data

    def _select(
        self, tensordict: TensorDictBase, keys: Iterable[NestedKey], where: str = ""
    ) -> TensorDictBase:
        try:
            return tensordict.select(*keys).detach()
        except KeyError:
            raise missing_key(type(self).__name__ + where, tensordict, keys) from None

    def values(self, name: str, data: TensorDictBase, *, frozen: bool = False) -> Tensor:
        """Return a critic's values ``[*S, *B]``, or ``[*S, 2, *B]`` of twin critics.

        Arguments as for `call_network`.
        """
        if self.twin_critics:
            dim = len(self.batch_size)
            data = data.select(*self.value_network.in_keys).unsqueeze(dim)
            data = data.expand(*data.batch_size[:dim], 2, *data.batch_size[dim + 1 :])
        data = self.call_network(name, data, frozen=frozen)
        return data.get(self.tensor_keys.state_action_value).squeeze(-1)

    def penalized(
        self, value: Tensor, data: TensorDictBase, tensordict: TensorDictBase
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Return ``-mean(value)`` plus a penalty that keeps the actor's tanh from saturating.

        The penalty is ``pre_tanh_penalty`` times the mean square of the actor's output before the
        tanh, over batch and action dimensions. ``value`` ``[*S, *B]`` and ``data`` are the values
        and the outputs of the actor; the transitions of ``tensordict`` give the weights.

        Returns:
            The loss, reduced, and ``"pre_tanh_magnitude"`` ``[*S]``, the root of that mean square.

        Raises:
            ValueError: If the actor wrote no ``"pre_tanh_action"`` to penalize.
        """
        loss = self.reduce(self.actor_objective(value, data, tensordict), tensordict)
        pre_tanh = data.get(self.tensor_keys.pre_tanh_action, None)
        if pre_tanh is None:
            return loss, {}
        square = self.flatten_batch(pre_tanh.detach().square())
        return loss, {"pre_tanh_magnitude": square.mean(-1).sqrt()}

    def actor_objective(
        self, value: Tensor, data: TensorDictBase, tensordict: TensorDictBase
    ) -> Tensor:
        """Return the objective of each transition ``[*S, *B]``; arguments as for `penalized`."""
        loss = -value
        if self.imitation:
            loss = loss + self.imitation * self.imitation_loss(data, tensordict)
        if self.pre_tanh_penalty:
            pre_tanh = data.get(self.tensor_keys.pre_tanh_action, None)
            if pre_tanh is None:
                raise ValueError(
                    f"the actor wrote no {self.tensor_keys.pre_tanh_action!r} to penalize: write "
                    "it, name it with set_keys(pre_tanh_action=...), or pass pre_tanh_penalty=0"
                )
            loss = loss + self.pre_tanh_penalty * pre_tanh.square().mean(-1)
        return loss

    def imitation_loss(self, data: TensorDictBase, tensordict: TensorDictBase) -> Tensor:
        """Return the squared distance ``[*S, *B]`` of the actor's actions to demonstrated ones.

        It is 0 for transitions that are not ``"demonstrated"``, bool ``[*S, *B]``; without this
        entry, none is.

        Args:
            data: Outputs of the actor in the states of the transitions.
            tensordict: The transitions.
        """
        keys = self.tensor_keys
        demonstrated = tensordict.get(keys.demonstrated, None)
        if demonstrated is None:
            return torch.zeros(tensordict.batch_size, device=tensordict.device)
        distance = (data.get(keys.action) - tensordict.get(keys.action)).square().sum(-1)
        return distance * demonstrated

    def reduce(self, loss: Tensor, tensordict: TensorDictBase) -> Tensor:
        """Return the weighted means ``[*S]`` of a loss ``[*S, *B]``, or their sum ``[]``."""
        mean = self.mean_per_seed(loss, tensordict)
        return mean.sum() if self.reduction == "sum" else mean

    def mean_per_seed(self, loss: Tensor, tensordict: TensorDictBase) -> Tensor:
        """Return the mean ``[*S]`` of ``[*S, *B]``, weighted by ``"priority_weight"``."""
        weights = tensordict.get(self.tensor_keys.priority_weight, None)
        if weights is not None and self.use_prioritized_weights:
            if weights.shape != loss.shape:
                raise ValueError(
                    f"{self.tensor_keys.priority_weight!r} must be one weight a transition, "
                    f"{[*loss.shape]}, got {[*weights.shape]}"
                )
            loss = loss * weights
        return self.flatten_batch(loss).mean(-1)

    def flatten_batch(self, values: Tensor) -> Tensor:
        """Flatten all but the leading dimensions ``S`` of values into one."""
        return values.reshape(*self.batch_size, -1)

    def call_network(
        self, name: str, data: TensorDictBase, *, frozen: bool = False
    ) -> TensorDictBase:
        """Apply the actor or value network, or its target, with its parameters in this loss.

        Args:
            name: ``"actor_network"``, ``"value_network"``, or one of these after ``"target_"``.
            data: Input of the network, which may write into it.
            frozen: Whether gradients reach the input only, not the parameters.
        """
        weights = {
            key if isinstance(key, str) else ".".join(key): value.detach() if frozen else value
            for key, value in getattr(self, f"{name}_params").items(True, True)
        }
        network = getattr(self, name.removeprefix("target_"))
        return functional_call(network, weights, (data,), tie_weights=False)


class ForeachSoftUpdate(SoftUpdate):
    """Soft update of target networks as TorchRL's `SoftUpdate`, in one kernel call.

    An update takes 0.02 ms in place of 0.33 ms for one actor and critic of 64 hidden units. Unlike
    TorchRL's, targets also follow parameters without gradient, such as those of `MAMLLoss`.

    Args:
        loss_module: Loss with target networks.
        tau: Share of the source that is taken over (Polyak averaging), in (0, 1].

    Raises:
        ValueError: If ``tau`` is out of range.

    Examples:
        >>> from bgpo_trl.modules.actor_critic import Actor, Critic
        >>> from bgpo_trl.objectives.ddpg import DDPGLoss
        >>> target_update = ForeachSoftUpdate(DDPGLoss(Actor(96), Critic(96)), tau=0.005)
        >>> target_update.step()  # after each step of the optimizer
    """

    def __init__(self, loss_module: LossModule, *, tau: float) -> None:
        if not 0 < tau <= 1:
            raise ValueError(f"tau must be above 0 and at most 1, got {tau}")
        super().__init__(loss_module, tau=tau)
        pairs = [
            pair
            for name, target in loss_module.named_children()
            if name.startswith("target_") and isinstance(target, TensorDictBase)
            for pair in _float_pairs(target, getattr(loss_module, name.removeprefix("target_")))
        ]
        self._target_tensors, self._source_tensors = map(list, zip(*pairs, strict=True))
        self._move = get_ema_multi_avg_fn(1 - tau)

    def step(self) -> None:
        """Update all targets: ``target <- (1 - tau) * target + tau * source``."""
        self._move(self._target_tensors, self._source_tensors, None)


def _float_pairs(
    targets: TensorDictBase, sources: TensorDictBase
) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield each floating-point target with its source, unless they share their memory."""
    for key, target in targets.items(True, True):
        source = sources[key]
        if target.is_floating_point() and not target.is_set_to(source.data):
            yield target, source
