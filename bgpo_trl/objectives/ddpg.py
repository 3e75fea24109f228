"""DDPG loss with an ensemble of critics, and a clone whose actions compete with the actor's."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from typing import Any, cast

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictParams, dispatch
from torch import Tensor
from torch.func import functional_call
from torch.optim.swa_utils import get_ema_multi_avg_fn
from torchrl.objectives import LossModule, SoftUpdate, ValueEstimators
from torchrl.objectives.value import TD0Estimator

from bgpo_trl.configs import RLConfig
from bgpo_trl.errors import missing_key


@dataclass
class TransitionKeys:
    """Names of the entries of `DDPGLoss`, to be changed with its ``set_keys``."""

    action: NestedKey = "action"
    """Action of a transition, and of the actor."""
    pre_tanh_action: NestedKey = "pre_tanh_action"
    """Output of the actor before its tanh."""
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
    """Factor of each transition's loss; the mean is over all transitions, whatever their weights
    (TorchRL's losses divide by the sum of the weights)."""
    imitation: NestedKey = "imitation"
    """Nested entry: demonstrated states and actions to imitate."""


class DDPGLoss(LossModule):
    """DDPG loss (Lillicrap et al., 2016; Eq. 8 of the paper) for one seed, or a stack ``S``.

    With one critic and no clone, it is :class:`torchrl.objectives.DDPGLoss`, with two additions for
    sparse rewards, without which Q grows to hundreds and every action saturates: targets are
    clipped to ``return_bounds``, and a penalty keeps actions before the tanh small.

    1. *Critics.* All ``N`` critics learn ``r + gamma ** k * V(s')``, where ``k`` is 1 or the number
       of steps of the transition. ``V`` is the lower value of two target critics. All pairs
       take turns, one in each call of `loss_value` (Chen et al., 2021, "Randomized Ensembled Double
       Q-Learning", draw pairs at random). If the actor learns in every second call, it sees every
       second pair: of five critics each, but the second most and the fourth least often; of four
       critics never the third.
    2. *Actor.* The actor ascends the mean of the same two critics. With a weight of ``imitation``,
       it descends the squared distance to demonstrated actions too (Nair et al., 2018, "Overcoming
       Exploration in Reinforcement Learning with Demonstrations"). The weight fades (Rajeswaran et
       al., 2018, "Learning Complex Dexterous Manipulation", likewise), as critics become better
       than demonstrations.
    3. *Clone*, if there is one. The clone learns demonstrated actions by their squared distance,
       without reward. ``V(s')`` is then the value of the better of two proposals, the target
       actor's action and the clone's action (Hu et al., 2024, "Imitation Bootstrapped Reinforcement
       Learning"). `ProposalPolicy` acts in the same way.

    A loss is a mean over the batch and a *sum* over ``S``, so that each seed has the gradient that
    it would have alone. Only ``"terminated"`` ends the bootstrap; a truncated episode goes on.
    Entries that are constant within an episode are read from the root, not from ``"next"``.

    Reads the ``in_keys`` of the networks, among them ``"action"`` ``[*S, *B, A]``; under ``"next"``
    those that are not constant, ``"reward"`` and ``"terminated"`` ``[*S, *B, 1]``; if present,
    ``"priority_weight"`` ``[*S, *B]``, a factor of each transition's loss, and
    ``"steps_to_next_obs"`` ``[*S, *B, 1]``, the power of gamma. A transition of several steps has
    the sum of the discounted rewards of these steps, and the state and ``"terminated"`` *after the
    last one*; `GroupReplay` makes such transitions. (TorchRL's ``MultiStep`` leaves
    ``"terminated"`` of the first step.) What imitates reads ``"imitation"``: its inputs,
    ``"action"`` and, if present, ``"priority_weight"``. Masks (``loss_mask_key``) are not read.
    Writes ``"td_error"`` ``[*S, *B]``, the largest squared error of the critics. Returns, without a
    batch size,

    - ``"loss_actor"``, ``"loss_value"`` and, with a clone, ``"loss_clone"``: ``[]``, or ``[*S]``
      without reduction, to be added;
    - ``"pred_value"`` ``[*S, *B]``, or ``[*S, N, *B]`` of an ensemble: values of the batch;
    - ``"target_value"`` ``[*S, *B]``: bootstrapped targets;
    - ``"pred_value_max"``, ``"target_value_max"``, ``"td_error_max"`` ``[*S]``: over the batch;
    - ``"pre_tanh_magnitude"`` ``[*S]``: root mean square of the actor's output before the tanh.

    Args:
        actor_network: Policy; its ``batch_size``, if it has one, is taken as ``S``. It must write
            ``"pre_tanh_action"`` unless the penalty is 0.
        value_network: Q-function with the ``batch_size`` ``[*S]``, or several with ``[*S, N]``.
        clone_network: Policy that imitates, with the inputs of the actor; ``None`` for none.
        n_critics: Number ``N`` of Q-functions.
        imitation: Weight of the actor's squared distance to demonstrated actions, at first.
        imitation_half_life: Calls of `loss_actor`, one in each update of an actor, in which this
            weight halves; ``None`` for never.
        return_bounds: Lowest and highest attainable return; ``None`` for no clipping. With a reward
            of 0 or 1 that ends the episode and an intrinsic reward of at most ``beta`` at its end,
            returns lie in ``[0, 1 + beta]``; if time-outs pay the intrinsic reward and bootstrap,
            up to ``beta + gamma * (1 + beta)``.
        pre_tanh_penalty: Weight of the mean square of the actor's output before the tanh.
        constant_keys: Entries of the networks' input that are constant within an episode.
        reduction: ``"sum"`` over ``S``, or ``"none"``.

    Raises:
        ValueError: If ``return_bounds`` is not an increasing pair, a weight is negative, the
            half-life is not positive, there is no such ``reduction``, or a ``batch_size`` does not
            fit; from ``forward``, if an entry is missing, or reward or weights have another
            shape.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from bgpo_trl.modules.actor_critic import Actor, Critic
        >>> def network(kind, *ensemble):
        ...     return kind(6, 4, in_keys=["state"], batch_size=(10, *ensemble))
        >>> loss = DDPGLoss(network(Actor), network(Critic, 5), network(Actor), n_critics=5)
        >>> loss.make_value_estimator(gamma=0.97)
        >>> target_update = ForeachSoftUpdate(loss, tau=0.005)
        >>> state, zero = torch.randn(10, 128, 6), torch.zeros(10, 128, 1)
        >>> shown = {"state": state, "action": torch.zeros(10, 128, 4)}
        >>> after = {"state": state, "reward": zero, "terminated": zero.bool()}
        >>> batch = TensorDict({**shown, "imitation": shown, "next": after}, [10, 128])
        >>> losses = loss(batch)
        >>> sum(losses[f"loss_{name}"] for name in ("value", "actor", "clone")).backward()
    """

    tensor_keys: TransitionKeys
    default_keys = TransitionKeys
    _AcceptedKeys = TransitionKeys  # pyright: ignore[reportAssignmentType] each loss has its own
    # The other estimators need whole trajectories, and replay serves single transitions.
    default_value_estimator = ValueEstimators.TD0

    actor_network: Any
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams
    value_network: Any
    value_network_params: TensorDictParams
    target_value_network_params: TensorDictParams
    clone_network: Any
    clone_network_params: TensorDictParams
    target_clone_network_params: TensorDictParams  # of TorchRL's making: the clone's own
    n_calls: Tensor
    n_imitated: Tensor

    def __init__(
        self,
        actor_network: Any,  # a TensorDictModuleBase; TorchRL's methods ask for a TensorDictModule
        value_network: Any,
        clone_network: Any | None = None,
        *,
        n_critics: int = 1,
        imitation: float = RLConfig.imitation,
        imitation_half_life: float | None = RLConfig.imitation_half_life,
        return_bounds: tuple[float, float] | None = None,
        pre_tanh_penalty: float = RLConfig.pre_tanh_penalty,
        constant_keys: Sequence[NestedKey] = (),
        reduction: str = "sum",
    ) -> None:
        weights = {"imitation": imitation, "pre_tanh_penalty": pre_tanh_penalty}
        for name, weight in weights.items():
            if not (weight >= 0 and math.isfinite(weight)):
                raise ValueError(f"{name} must be a number >= 0, got {weight}")
        if imitation_half_life is not None and not imitation_half_life > 0:
            raise ValueError(f"imitation_half_life must be above 0, got {imitation_half_life}")
        if return_bounds is not None and not return_bounds[0] < return_bounds[1]:
            raise ValueError(f"return_bounds must be (low, high) with low < high: {return_bounds}")
        if reduction not in ("sum", "none"):
            raise ValueError(f"reduction must be sum or none, got {reduction!r}")
        super().__init__()
        self.batch_size = _batch_size(actor_network)
        self.n_critics, self.ensemble = n_critics, n_critics > 1
        critics, wanted = _batch_size(value_network), [*self.batch_size]
        if self.ensemble:
            wanted.append(n_critics)
        # A single Q-function without a batch size may be any module.
        if [*critics] != wanted and (self.ensemble or critics):
            raise ValueError(
                f"value_network must have the batch_size {wanted}, that of the actor and then "
                f"n_critics if there are several, got {[*critics]}: a network in a container such "
                "as TensorDictSequential has none"
            )
        if clone_network is not None and _batch_size(clone_network) != self.batch_size:
            raise ValueError(
                f"clone_network must have the actor's batch_size {[*self.batch_size]}, got "
                f"{[*_batch_size(clone_network)]}"
            )
        self.convert_to_functional(actor_network, "actor_network", create_target_params=True)
        self.convert_to_functional(value_network, "value_network", create_target_params=True)
        self.has_clone = clone_network is not None
        if clone_network is not None:
            self.convert_to_functional(clone_network, "clone_network")
        self.return_bounds, self.reduction = return_bounds, reduction
        self.imitation, self.imitation_half_life = imitation, imitation_half_life
        self.pre_tanh_penalty = pre_tanh_penalty
        written = set(actor_network.out_keys)
        read = [*actor_network.in_keys, *(k for k in value_network.in_keys if k not in written)]
        self.input_keys = [*dict.fromkeys(unravel_key(key) for key in read)]
        self.constant_keys = [unravel_key(key) for key in constant_keys]
        unknown = [key for key in self.constant_keys if key not in self.input_keys]
        if unknown:
            raise ValueError(f"constant_keys must be among {self.input_keys}, got {unknown}")
        self._pairs = [*combinations(range(n_critics), 2)] or [(0, 0)]
        self.register_buffer("n_calls", torch.zeros((), dtype=torch.int64))
        # Of each actor, as actors come to new tasks at different times.
        device = next(iter(self.actor_network_params.values(True, True))).device
        counts = torch.zeros(self.batch_size, dtype=torch.int64, device=device)
        self.register_buffer("n_imitated", counts)

    @property
    def in_keys(self) -> list[NestedKey]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Entries that `forward` accepts."""
        keys = self.tensor_keys
        read = [*self.input_keys, *self.value_network.in_keys, keys.priority_weight]
        following = [*self.input_keys, keys.reward, keys.done, keys.terminated]
        imitates = self.has_clone or self.imitation
        shown = [*self.actor_network.in_keys, keys.action] if imitates else []
        nested = [("next", key) for key in following] + [(keys.imitation, key) for key in shown]
        return [*dict.fromkeys(read), *(unravel_key(key) for key in nested)]

    @property
    def out_keys(self) -> list[NestedKey]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Entries that `forward` returns."""
        of_value = ["pred_value", "target_value", "pred_value_max", "target_value_max"]
        clone = ["loss_clone"] if self.has_clone else []
        # An actor that does not write this entry has no magnitude to report.
        writes = self.tensor_keys.pre_tanh_action in self.actor_network.out_keys
        magnitude = ["pre_tanh_magnitude"] if writes else []
        return ["loss_actor", "loss_value", *clone, *of_value, "td_error_max", *magnitude]

    def make_value_estimator(self, value_type: Any = None, **hyperparams: Any) -> None:
        """Set the estimator of the target.

        Args:
            value_type: ``ValueEstimators.TD0``, or a ``TD0Estimator`` of TorchRL.
            **hyperparams: Arguments of the estimator; ``gamma`` is `RLConfig.gamma` by default.

        Raises:
            ValueError: If gamma does not lie in [0, 1].
            NotImplementedError: If the estimator is another one.
        """
        hyperparams = {"gamma": RLConfig.gamma, "value_network": None, **hyperparams}
        if not 0 <= hyperparams["gamma"] <= 1:
            raise ValueError(f"gamma must be between 0 and 1, got {hyperparams['gamma']}")
        if value_type is None or value_type == ValueEstimators.TD0:
            value_type = TD0Estimator
        kind = value_type if isinstance(value_type, type) else type(value_type)
        if not issubclass(kind, TD0Estimator):
            name = value_type if isinstance(value_type, ValueEstimators) else kind.__name__
            raise NotImplementedError(f"{name} needs whole trajectories: choose TD0")
        super().make_value_estimator(cast(Any, value_type), **hyperparams)
        self.set_keys()  # the names of the entries, to the estimator too

    @dispatch()
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Compute all losses of a batch of transitions ``[*S, *B]``; see the class."""
        loss_value, of_value = self.loss_value(tensordict)
        loss_actor, of_actor = self.loss_actor(tensordict)
        losses = {"loss_actor": loss_actor, "loss_value": loss_value}
        if self.has_clone:
            losses["loss_clone"] = self.loss_clone(tensordict)
        return TensorDict({**losses, **of_value, **of_actor})

    def loss_value(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute the critics' loss, reduced, and further entries; write ``"td_error"``."""
        with torch.no_grad():
            target = self.target(tensordict)
        data = self._select(tensordict, self.value_network.in_keys)
        prediction = self.values("value_network", data)
        dim = len(self.batch_size)
        wanted = target.unsqueeze(dim).expand_as(prediction) if self.ensemble else target
        distance = torch.nn.functional.mse_loss(prediction, wanted, reduction="none")
        prediction, td_error = prediction.detach(), distance.detach()
        if self.ensemble:
            distance, td_error = distance.sum(dim), td_error.amax(dim)
        tensordict.set(self.tensor_keys.priority, td_error)
        return self.reduce(distance, tensordict), {
            "pred_value": prediction,
            "target_value": target,
            "pred_value_max": self.flatten_batch(prediction).amax(-1),
            "target_value_max": self.flatten_batch(target).amax(-1),
            "td_error_max": self.flatten_batch(td_error).amax(-1),
        }

    def target(self, tensordict: TensorDictBase) -> Tensor:
        """Return the clipped bootstrapped targets of transitions, ``[*S, *B]``.

        Each call is the turn of another `pair` of critics, and counts as an update (`n_calls`).

        Raises:
            ValueError: If the reward has another shape, or transitions are of TorchRL's
                ``MultiStep``.
        """
        self.n_calls += 1
        if "nonterminal" in tensordict:  # which MultiStep writes
            raise ValueError(
                "TorchRL's MultiStep leaves 'terminated' of the first step, by which targets would "
                "be wrong: make transitions of several steps with GroupReplay(n_steps=...)"
            )
        next_value = self.next_value(self.following(tensordict)).unsqueeze(-1)
        reward = tensordict.get(("next", self.tensor_keys.reward))
        if reward.shape != next_value.shape:
            raise ValueError(
                f"the reward must be {[*next_value.shape]}, as the value is, got {[*reward.shape]}"
            )
        target = self.value_estimator.value_estimate(tensordict, next_value=next_value).squeeze(-1)
        return target if self.return_bounds is None else target.clamp(*self.return_bounds)

    def next_value(self, successor: TensorDictBase) -> Tensor:
        """Return the values ``[*S, *B]`` of the best proposal in next states."""
        proposals = [self.call_network("target_actor_network", successor.copy())]
        if self.has_clone:
            proposals.append(self.call_network("clone_network", successor.copy()))
        if not self.ensemble:  # whose critic may be any module, such as one with batch norm
            values = [self.values("target_value_network", one) for one in proposals]
            return values[0] if len(values) == 1 else torch.maximum(*values)
        dim, keys = len(self.batch_size), self.value_network.in_keys
        data = TensorDict.maybe_dense_stack([one.select(*keys) for one in proposals], dim)
        values = self.values("target_value_network", data, critics=self.pair)
        return values.amin(dim).amax(dim)

    @property
    def pair(self) -> tuple[int, int]:
        """Positions of the two critics whose turn it is; twice 0 if there is only one."""
        return self._pairs[int(self.n_calls) % len(self._pairs)]

    def loss_actor(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute the actor's loss, reduced, and ``"pre_tanh_magnitude"``."""
        data = self.call_network("actor_network", self.current(tensordict))
        loss = self.mean_per_seed(self.actor_objective(data), tensordict)
        if self.imitation:
            actor = partial(self.call_network, "actor_network")
            loss = loss + self.imitation_weight * self.distance(actor, tensordict)
            self.n_imitated += self.trains(tensordict)
        loss = self.reduce_seeds(loss)
        pre_tanh = data.get(self.tensor_keys.pre_tanh_action, None)
        if pre_tanh is None:
            return loss, {}
        square = self.flatten_batch(pre_tanh.detach().square())
        return loss, {"pre_tanh_magnitude": square.mean(-1).sqrt()}

    def actor_objective(self, data: TensorDictBase) -> Tensor:
        """Return minus the value, plus the penalty, of the actor's outputs ``[*S, *B]``.

        Raises:
            ValueError: If the actor wrote no ``"pre_tanh_action"`` to penalize.
        """
        values = self.values("value_network", data, frozen=True, critics=self.pair)
        loss = -(values.mean(len(self.batch_size)) if self.ensemble else values)
        if self.pre_tanh_penalty:
            pre_tanh = data.get(self.tensor_keys.pre_tanh_action, None)
            if pre_tanh is None:
                raise ValueError(
                    f"the actor wrote no {self.tensor_keys.pre_tanh_action!r} to penalize: write "
                    "it, name it with set_keys(pre_tanh_action=...), or pass pre_tanh_penalty=0"
                )
            loss = loss + self.pre_tanh_penalty * pre_tanh.square().mean(-1)
        return loss

    def loss_clone(self, tensordict: TensorDictBase) -> Tensor:
        """Compute the clone's squared distance to demonstrated actions, reduced."""
        clone = partial(self.call_network, "clone_network")
        return self.reduce_seeds(self.distance(clone, tensordict))

    def distance(
        self, policy: Callable[[TensorDictBase], TensorDictBase], tensordict: TensorDictBase
    ) -> Tensor:
        """Return the mean squared distance ``[*S]`` of a policy to demonstrated actions.

        Raises:
            ValueError: If an entry is missing.
        """
        keys = self.tensor_keys
        shown = tensordict.get(keys.imitation, None)
        if not isinstance(shown, TensorDictBase) or keys.action not in shown:
            wanted = [(keys.imitation, keys.action)]
            raise missing_key(type(self).__name__, tensordict, wanted)
        states = self._select(shown, self.actor_network.in_keys, ", under 'imitation',")
        apart = policy(states).get(keys.action) - shown.get(keys.action)
        return self.mean_per_seed(apart.square().sum(-1), shown)

    @property
    def imitation_weight(self) -> Tensor:
        """Weight of the imitation of each actor now, ``[*S]``."""
        halved = self.n_imitated / (self.imitation_half_life or math.inf)
        return self.imitation * 0.5**halved

    def trains(self, tensordict: TensorDictBase) -> Tensor:
        """Return which networks ``[*S]`` have transitions ``[*S, *B]`` of any weight."""
        weights = tensordict.get(self.tensor_keys.priority_weight, None)
        if weights is None:
            return torch.ones_like(self.n_imitated, dtype=torch.bool)
        return (self.flatten_batch(weights) > 0).any(-1)

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
        if (dtype := successor.get(names.terminated).dtype) != torch.bool:
            # Of integers, the estimator would take the bitwise complement.
            raise ValueError(f"('next', {names.terminated!r}) must be bool, got {dtype}")
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

    def values(
        self,
        name: str,
        data: TensorDictBase,
        *,
        frozen: bool = False,
        critics: Sequence[int] | None = None,
    ) -> Tensor:
        """Return the values ``[*S, *B]`` of a critic, or ``[*S, N, *B]`` of an ensemble.

        ``critics`` are the positions of some of an ensemble; other arguments as for `call_network`.
        """
        if self.ensemble:
            dim = len(self.batch_size)
            data = data.select(*self.value_network.in_keys).unsqueeze(dim)
            n_critics = len(critics) if critics else self.n_critics
            data = data.expand(*data.batch_size[:dim], n_critics, *data.batch_size[dim + 1 :])
        data = self.call_network(name, data, frozen=frozen, members=critics)
        return data.get(self.tensor_keys.state_action_value).squeeze(-1)

    def reduce(self, loss: Tensor, tensordict: TensorDictBase) -> Tensor:
        """Return the weighted means ``[*S]`` of a loss ``[*S, *B]``, or their sum ``[]``."""
        return self.reduce_seeds(self.mean_per_seed(loss, tensordict))

    def reduce_seeds(self, mean: Tensor) -> Tensor:
        """Return means ``[*S]`` as they are, or their sum ``[]``."""
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
        self,
        name: str,
        data: TensorDictBase,
        *,
        frozen: bool = False,
        members: Sequence[int] | None = None,
    ) -> TensorDictBase:
        """Apply a network with its parameters in this loss.

        Args:
            name: ``"actor_network"``, ``"value_network"``, one of these after ``"target_"``, or
                ``"clone_network"``.
            data: Input of the network, which may write into it.
            frozen: Whether gradients reach the input only, not the parameters.
            members: Positions of some networks of an ensemble; ``None`` for all.
        """
        dim = len(self.batch_size)
        weights: dict[str, Tensor] = {}
        for key, value in getattr(self, f"{name}_params").items(True, True):
            value = value.detach() if frozen else value
            if members is not None and self.ensemble:
                value = torch.stack([value.select(dim, member) for member in members], dim)
            weights[key if isinstance(key, str) else ".".join(key)] = value
        network = getattr(self, name.removeprefix("target_"))
        return functional_call(network, weights, (data,), tie_weights=False)


def _batch_size(network: Any) -> torch.Size:
    return torch.Size(getattr(network, "batch_size", ()))


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
        self._target_tensors, self._source_tensors = list[Tensor](), list[Tensor]()
        for name, targets in loss_module.named_children():
            if name.startswith("target_") and isinstance(targets, TensorDictBase):
                sources = getattr(loss_module, name.removeprefix("target_"))
                for key, target in targets.items(True, True):
                    # Those that share their memory have nothing to follow.
                    if target.is_floating_point() and not target.is_set_to(sources[key].data):
                        self._target_tensors.append(target)
                        self._source_tensors.append(sources[key])
        self._decay = 1 - tau

    def step(self) -> None:
        """Update all targets: ``target <- (1 - tau) * target + tau * source``."""
        move = get_ema_multi_avg_fn(self._decay)  # a closure, which could not be pickled
        move(self._target_tensors, self._source_tensors, None)
