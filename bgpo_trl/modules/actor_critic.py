"""Policy and Q-function: two-layer perceptrons, with an optional batch of seeds in their weights.

The paper (section IV-A): "The policy and Q-functions are parameterized by a 2-layer MLP each. The
hidden layer is 64-dimensional with ReLU activation. The output layer is 1-dimensional with linear
activation in the Q-network and 4-dimensional with tanh activation in the policy network."
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
import torch.nn.functional as F
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import Tensor, nn

from bgpo_trl.modules.entries import read

__all__ = ["Actor", "Critic", "StackedLinear", "StackedMLP"]


class StackedLinear(nn.Module):
    """A linear layer that holds one weight matrix per seed and applies all of them in one call.

    With ``batch_size=()`` it computes what :class:`torch.nn.Linear` computes. Weights and biases
    start uniform in ``±1/sqrt(in_features)``, as there.

    Args:
        in_features: size of the last input dimension.
        out_features: size of the last output dimension.
        batch_size: leading dimensions ``S`` of the weights, one independent layer for each index;
            ``()`` for a single layer.
        generator: source of the initial weights. One generator fills all layers from one stream; a
            sequence holds one per layer, in the order of the flattened ``batch_size``, and layer
            ``i`` then starts exactly as a single layer that draws from generator ``i``. ``None``
            draws from torch's default generator.

    Attributes:
        weight: ``[*S, in_features, out_features]``.
        bias: ``[*S, out_features]``.

    Raises:
        ValueError: if the number of generators is not the number of layers.

    Examples:
        >>> layer = StackedLinear(3, 5, batch_size=(10,))
        >>> layer(torch.zeros(10, 256, 3)).shape
        torch.Size([10, 256, 5])
    """

    def __init__(
        self,
        in_features: int,
        out_features: int,
        batch_size: Sequence[int] = (),
        generator: torch.Generator | Sequence[torch.Generator] | None = None,
    ) -> None:
        super().__init__()
        if in_features < 1 or out_features < 1:
            raise ValueError(
                "in_features and out_features must be at least 1, "
                f"got {in_features} and {out_features}"
            )
        self.in_features = in_features
        self.out_features = out_features
        self.batch_size = torch.Size(batch_size)
        self.weight = nn.Parameter(torch.empty(*self.batch_size, in_features, out_features))
        self.bias = nn.Parameter(torch.empty(*self.batch_size, out_features))
        self.reset_parameters(generator)

    @torch.no_grad()
    def reset_parameters(
        self, generator: torch.Generator | Sequence[torch.Generator] | None = None
    ) -> None:
        """Draw all weights and biases anew.

        Args:
            generator: as in the constructor.

        Raises:
            ValueError: if the number of generators is not the number of layers.
        """
        bound = 1 / math.sqrt(self.in_features)
        if generator is None or isinstance(generator, torch.Generator):
            self.weight.uniform_(-bound, bound, generator=generator)
            self.bias.uniform_(-bound, bound, generator=generator)
            return
        n_layers = self.batch_size.numel()
        if len(generator) != n_layers:
            raise ValueError(
                f"pass one generator per layer: batch_size {tuple(self.batch_size)} needs "
                f"{n_layers}, got {len(generator)}"
            )
        weights = self.weight.view(n_layers, self.in_features, self.out_features)
        biases = self.bias.view(n_layers, self.out_features)
        for weight, bias, stream in zip(weights, biases, generator, strict=True):
            weight.uniform_(-bound, bound, generator=stream)
            bias.uniform_(-bound, bound, generator=stream)

    def forward(self, *inputs: Tensor) -> Tensor:
        """Apply each layer to its own slice of the inputs, side by side along the last dimension.

        Inputs are not concatenated: each is multiplied with its own rows of the weights. That saves
        the copy, and the gradient of an input that needs none.

        Args:
            *inputs: ``[*S, *B, features]`` each, with any number of further batch dimensions ``B``
                and ``in_features`` features together.

        Returns:
            ``[*S, *B, out_features]``.

        Raises:
            ValueError: if an input does not lead with the ``batch_size`` of the weights, or the
                inputs do not have ``in_features`` together.
        """
        sizes = [input.shape[-1] for input in inputs]
        # Not self.batch_size: the layer may be called with weights of another stack.
        stack = self.weight.shape[:-2]
        if sum(sizes) != self.in_features or any(
            input.shape[: len(stack)] != stack for input in inputs
        ):
            raise ValueError(
                f"the inputs must have one leading index per layer and {self.in_features} features "
                f"together, shape {[*stack]} + [*B, {self.in_features}], got "
                f"{' and '.join(str([*input.shape]) for input in inputs)}"
            )
        n_layers = stack.numel()
        weight = self.weight.reshape(n_layers, self.in_features, self.out_features)
        output = self.bias.reshape(n_layers, 1, self.out_features)
        for i, (input, rows) in enumerate(zip(inputs, weight.split(sizes, -2), strict=True)):
            multiply_add = torch.Tensor.baddbmm_ if i else torch.Tensor.baddbmm
            output = multiply_add(output, input.reshape(n_layers, -1, input.shape[-1]), rows)
        shape = torch.Size([*inputs[0].shape[:-1], self.out_features])
        # Not a view where none is needed: autograd is slow with what is then changed in place.
        return output if output.shape == shape else output.view(shape)


class StackedMLP(nn.Module):
    """A perceptron of :class:`StackedLinear` layers with ReLU between them.

    With ``layer_norm``, each hidden layer's output is normalized over its units (Ba et al., 2016,
    without gain and bias) before the ReLU. In a Q-function this bounds what it can say about
    actions it has never seen (Ball et al., 2023, "Efficient Online Reinforcement Learning with
    Offline Data").

    Args:
        in_features: size of the last dimension of all inputs together.
        out_features: size of the last output dimension.
        hidden_sizes: width of each hidden layer.
        layer_norm: whether to normalize the hidden layers.
        batch_size: leading dimensions ``S`` of the weights.
        generator: as in :class:`StackedLinear`.

    Raises:
        ValueError: if the number of generators is not the number of stacked perceptrons.

    Examples:
        >>> mlp = StackedMLP(96, 4)
        >>> mlp(torch.zeros(256, 64), torch.zeros(256, 32)).shape
        torch.Size([256, 4])
    """

    def __init__(
        self,
        in_features: int,
        out_features: int,
        *,
        hidden_sizes: Sequence[int] = (64,),
        layer_norm: bool = False,
        batch_size: Sequence[int] = (),
        generator: torch.Generator | Sequence[torch.Generator] | None = None,
    ) -> None:
        super().__init__()
        self.layer_norm = layer_norm
        sizes = [in_features, *hidden_sizes, out_features]
        self.layers = nn.ModuleList(
            StackedLinear(n_in, n_out, batch_size, generator) for n_in, n_out in pairwise(sizes)
        )

    def forward(self, *inputs: Tensor) -> Tensor:
        """Map the inputs, side by side along their last dimension, to the output.

        Args:
            *inputs: ``[*S, *B, features]`` each, ``in_features`` together.

        Returns:
            ``[*S, *B, out_features]``, without an output nonlinearity.
        """
        first, *others = self.layers
        x = first(*inputs)
        for layer in others:
            if self.layer_norm:
                x = F.layer_norm(x, x.shape[-1:])
            x = layer(x.relu_())
        return x


# Actor and Critic derive from TensorDictModuleBase because TensorDictModule.forward itself costs
# 0.12 ms a call (tensordict 0.14), more than these networks, four times an update.


class Actor(TensorDictModuleBase):
    """Deterministic policy: an MLP with tanh output.

    Reads ``in_keys`` (``[*S, *B, features]`` each) and writes ``"action"`` ``[*S, *B, action_dim]``
    in [-1, 1] and ``"pre_tanh_action"``, the same before the tanh, which
    :class:`~bgpo_trl.objectives.ddpg.DDPGLoss` keeps small.

    Args:
        in_features: size of all ``in_keys`` together; 64 + 32 for latent and behavior.
        action_dim: number of action components.
        in_keys: entries to read, concatenated in this order.
        hidden_sizes: width of each hidden layer.
        batch_size: leading dimensions ``S`` of the weights, one independent policy for each index.
        generator: source of the initial weights, as in :class:`StackedLinear`.

    Raises:
        ValueError: if the number of generators is not the number of policies.

    Examples:
        >>> from tensordict import TensorDict
        >>> actor = Actor(batch_size=(10,))
        >>> data = TensorDict({"latent": torch.zeros(10, 64), "behavior": torch.zeros(10, 32)}, 10)
        >>> actor(data)["action"].shape
        torch.Size([10, 4])
    """

    in_keys: list[NestedKey]

    def __init__(
        self,
        in_features: int = 96,
        action_dim: int = 4,
        *,
        in_keys: Sequence[NestedKey] = ("latent", "behavior"),
        hidden_sizes: Sequence[int] = (64,),
        batch_size: Sequence[int] = (),
        generator: torch.Generator | Sequence[torch.Generator] | None = None,
    ) -> None:
        super().__init__()
        self.in_keys = list(in_keys)
        self.out_keys = ["pre_tanh_action", "action"]
        self.batch_size = torch.Size(batch_size)
        self.mlp = StackedMLP(
            in_features,
            action_dim,
            hidden_sizes=hidden_sizes,
            batch_size=batch_size,
            generator=generator,
        )

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action for each state.

        Args:
            tensordict: with ``in_keys``; ``"action"`` and ``"pre_tanh_action"`` are set in it.

        Returns:
            The same tensordict.
        """
        pre_tanh = self.mlp(*read(self, tensordict))
        tensordict.set("pre_tanh_action", pre_tanh)
        return tensordict.set("action", pre_tanh.tanh())


class Critic(TensorDictModuleBase):
    """Q-function: an MLP on state and action with a linear output.

    Reads ``in_keys`` (``[*S, *B, features]`` each) and ``"action"`` ``[*S, *B, action_dim]``;
    writes ``"state_action_value"`` ``[*S, *B, 1]``.

    Args:
        in_features: size of all ``in_keys`` together, the action not counted.
        action_dim: number of action components.
        in_keys: entries to read, concatenated in this order; the action comes last.
        hidden_sizes: width of each hidden layer.
        layer_norm: whether to normalize the hidden layers, see :class:`StackedMLP`.
        batch_size: leading dimensions ``S`` of the weights, one independent Q-function per index.
        generator: source of the initial weights, as in :class:`StackedLinear`.

    Raises:
        ValueError: if the number of generators is not the number of Q-functions.

    Examples:
        >>> from tensordict import TensorDict
        >>> critic = Critic(3, 2, in_keys=["state"])
        >>> data = TensorDict({"state": torch.zeros(7, 3), "action": torch.zeros(7, 2)}, 7)
        >>> critic(data)["state_action_value"].shape
        torch.Size([7, 1])
    """

    in_keys: list[NestedKey]

    def __init__(
        self,
        in_features: int = 96,
        action_dim: int = 4,
        *,
        in_keys: Sequence[NestedKey] = ("latent", "behavior"),
        hidden_sizes: Sequence[int] = (64,),
        layer_norm: bool = False,
        batch_size: Sequence[int] = (),
        generator: torch.Generator | Sequence[torch.Generator] | None = None,
    ) -> None:
        super().__init__()
        self.in_keys = [*in_keys, "action"]
        self.out_keys = ["state_action_value"]
        self.batch_size = torch.Size(batch_size)
        self.mlp = StackedMLP(
            in_features + action_dim,
            1,
            hidden_sizes=hidden_sizes,
            layer_norm=layer_norm,
            batch_size=batch_size,
            generator=generator,
        )

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the value of each state and action.

        Args:
            tensordict: with ``in_keys``; ``"state_action_value"`` is set in it.

        Returns:
            The same tensordict.
        """
        value = self.mlp(*read(self, tensordict))
        return tensordict.set("state_action_value", value)
