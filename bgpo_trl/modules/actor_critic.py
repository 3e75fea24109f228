"""Policies and Q-function: perceptrons, with an optional stack of seeds in their weights.

Paper, Sec. IV-A: one hidden layer of 64 ReLU units, and an output layer that is linear in the
Q-function and tanh in the policy. The default here is two of 256 units (`RLConfig.hidden_sizes`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import Tensor

from bgpo_trl.errors import missing_key
from bgpo_trl.modules.stacked_mlp import StackedMLP


class StackedNetwork(TensorDictModuleBase):
    """Base of policies and Q-functions: a perceptron on entries of a TensorDict.

    A subclass makes its `StackedMLP`, the first of its submodules, and calls it with `input`.

    Args:
        in_keys: Entries to read, side by side in this order, ``[*S, *B, features]`` each.
        out_keys: Entries that ``forward`` writes.

    Raises:
        ValueError: From ``forward``, if an entry is missing.
    """

    # Not a TensorDictModule: its forward adds 10 % to a DDPG update of 5 seeds with 256 units and
    # 128 transitions, which calls five networks (median of the ratios of 250 pairs, CPU time).

    in_keys: list[NestedKey]

    def __init__(self, in_keys: Sequence[NestedKey], out_keys: Sequence[str]) -> None:
        super().__init__()
        self.in_keys = list(in_keys)
        self.out_keys = [*out_keys]

    @property
    def batch_size(self) -> torch.Size:
        """Leading dimensions ``S`` of the weights."""
        return cast(StackedMLP, next(self.children())).batch_size

    def input(self, tensordict: TensorDictBase) -> Tensor:
        """Return the values of ``in_keys`` side by side; raise ``ValueError`` if one is missing."""
        try:
            values = [tensordict[key] for key in self.in_keys]
            return values[0] if len(values) == 1 else torch.cat(values, -1)
        except KeyError:
            raise missing_key(type(self).__name__, tensordict, self.in_keys) from None


class Actor(StackedNetwork):
    """Deterministic policy: an MLP with tanh output.

    Reads ``in_keys``; writes ``"action"`` ``[*S, *B, action_dim]`` in [-1, 1] and
    ``"pre_tanh_action"``, the same before the tanh, which `DDPGLoss` keeps small.

    Args:
        in_features: Size of all ``in_keys`` together; 64 + 32 for latent and behavior.
        action_dim: Number of action components.
        in_keys: Entries to read, ``[*S, *B, features]`` each.
        **mlp: ``hidden_sizes``, ``layer_norm``, ``batch_size`` and ``generator`` of `StackedMLP`.

    Examples:
        >>> from tensordict import TensorDict
        >>> actor = Actor(96, batch_size=(10,))
        >>> data = TensorDict({"latent": torch.zeros(10, 64), "behavior": torch.zeros(10, 32)}, 10)
        >>> actor(data)["action"].shape
        torch.Size([10, 4])
    """

    def __init__(
        self,
        in_features: int,
        action_dim: int = 4,
        *,
        in_keys: Sequence[NestedKey] = ("latent", "behavior"),
        **mlp: Any,
    ) -> None:
        super().__init__(in_keys, ["pre_tanh_action", "action"])
        self.mlp = StackedMLP(in_features, action_dim, **mlp)

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the actions of states; return the same tensordict."""
        pre_tanh = self.mlp(self.input(tensordict))
        tensordict.set("pre_tanh_action", pre_tanh)
        return tensordict.set("action", pre_tanh.tanh())


class Critic(StackedNetwork):
    """Q-function: an MLP on state and action with a linear output.

    Reads ``in_keys`` and ``"action"``; writes ``"state_action_value"`` ``[*S, *B, 1]``. Arguments
    as for `Actor`, without the action in ``in_features`` and ``in_keys``.

    Examples:
        >>> from tensordict import TensorDict
        >>> critic = Critic(3, 2, in_keys=["state"])
        >>> data = TensorDict({"state": torch.zeros(7, 3), "action": torch.zeros(7, 2)}, 7)
        >>> critic(data)["state_action_value"].shape
        torch.Size([7, 1])
    """

    def __init__(
        self,
        in_features: int,
        action_dim: int = 4,
        *,
        in_keys: Sequence[NestedKey] = ("latent", "behavior"),
        **mlp: Any,
    ) -> None:
        super().__init__([*in_keys, "action"], ["state_action_value"])
        self.mlp = StackedMLP(in_features + action_dim, 1, **mlp)

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the values of states and actions; return the same tensordict."""
        value = self.mlp(self.input(tensordict))
        return tensordict.set("state_action_value", value)


class ProposalPolicy(TensorDictModuleBase):
    """Policy that takes the better of two proposals, if critics are sure which is better.

    At each step, an actor and a clone of demonstrations propose an action (Hu et al., 2024,
    "Imitation Bootstrapped Reinforcement Learning"). Each critic says how much more the actor's
    action is worth. The policy takes the actor's action if the mean of these gains is above
    ``caution`` times their standard deviation, else the clone's. Where critics disagree, as they do
    before they have seen much, the clone acts. `DDPGLoss` bootstraps from the better proposal.

    Reads the ``in_keys`` of the actor; writes ``"action"`` ``[*S, *B, A]``.

    Args:
        actor: Policy that writes ``"action"``, with ``batch_size`` ``[*S]``.
        clone: Policy with the same keys and ``batch_size``.
        critic: Q-functions of ``batch_size`` ``[*S, N]``, at least two of them.
        caution: See above; 0 compares the means.

    Raises:
        ValueError: If there are not at least two critics of each policy.

    Attributes:
        only_clone: Where the policy takes the action of the clone whatever the critics say, bool
            ``[*S]``.

    Examples:
        >>> from tensordict import TensorDict
        >>> def network(kind, *ensemble):
        ...     return kind(6, 4, in_keys=["state"], batch_size=(10, *ensemble))
        >>> policy = ProposalPolicy(network(Actor), network(Actor), network(Critic, 5))
        >>> policy(TensorDict({"state": torch.zeros(10, 6)}, 10))["action"].shape
        torch.Size([10, 4])
    """

    in_keys: list[NestedKey]
    only_clone: Tensor

    def __init__(self, actor: Actor, clone: Actor, critic: Critic, caution: float = 1.0) -> None:
        super().__init__()
        *batch, n_critics = (*critic.batch_size,) or (1,)
        if (*batch,) != (*actor.batch_size,) or n_critics < 2:
            raise ValueError(
                f"critic must have the batch_size {[*actor.batch_size]} and at least 2 critics, "
                f"got {[*critic.batch_size]}"
            )
        self.caution = caution
        self.in_keys, self.out_keys = actor.in_keys, ["action"]
        self.actor, self.clone, self.critic = actor, clone, critic
        self.register_buffer("only_clone", torch.zeros(actor.batch_size, dtype=torch.bool))

    @property
    def batch_size(self) -> torch.Size:
        """Leading dimensions ``S`` of the weights."""
        return self.actor.batch_size

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the actions of states; return the same tensordict."""
        inputs = tensordict.select(*self.in_keys)
        cloned, own = (net(inputs.copy())["action"] for net in (self.clone, self.actor))
        dim = len(self.batch_size)
        both = inputs.unsqueeze(dim).expand(*inputs.shape[:dim], 2, *inputs.shape[dim:]).clone()
        both.set("action", torch.stack([cloned, own], dim))
        of_each = both.unsqueeze(dim)
        of_each = of_each.expand(*self.critic.batch_size, *both.shape[dim:])
        value_of_clone, value_of_actor = self.critic(of_each)["state_action_value"].unbind(dim + 1)
        gain = value_of_actor - value_of_clone
        only_clone = self.only_clone.reshape(*self.batch_size, *[1] * (own.ndim - dim))
        takes_actor = (gain.mean(dim) > self.caution * gain.std(dim)) & ~only_clone
        return tensordict.set("action", torch.where(takes_actor, own, cloned))
