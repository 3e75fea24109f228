"""Perceptrons that hold the weights of a stack of seeds and apply all of them in one call."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from bgpo_trl.configs import RLConfig
from bgpo_trl.errors import as_shape
from bgpo_trl.seeding import one_each


class StackedLinear(nn.Module):
    """Linear layer with one weight matrix per seed, all of them applied in one call.

    With ``batch_size=()`` it computes what :class:`torch.nn.Linear` computes, and starts with
    weights from the same distribution, uniform in ``±1/sqrt(in_features)``. It takes the shape of
    the stack from its weights, so :func:`torch.func.functional_call` may pass those of any other
    stack.

    Args:
        in_features: Size of the last input dimension.
        out_features: Size of the last output dimension.
        batch_size: Leading dimensions ``S`` of the weights, one independent layer for each index,
            or their length.
        generator: Source of the initial weights: one for all layers, or one per layer in the order
            of the flattened ``batch_size``, each of which starts as a single layer would. ``None``:
            torch's default generator.

    Attributes:
        weight: ``[*S, in_features, out_features]``.
        bias: ``[*S, out_features]``.

    Raises:
        ValueError: If a size is less than 1, or the number of generators is not that of layers.

    Examples:
        >>> layer = StackedLinear(3, 5, batch_size=(10,))
        >>> layer(torch.zeros(10, 256, 3)).shape
        torch.Size([10, 256, 5])
    """

    def __init__(
        self,
        in_features: int,
        out_features: int,
        batch_size: int | Sequence[int] = (),
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
        batch_size = as_shape(batch_size, "batch_size")
        self.weight = nn.Parameter(torch.empty(*batch_size, in_features, out_features))
        self.bias = nn.Parameter(torch.empty(*batch_size, out_features))
        self.reset_parameters(generator)

    @torch.no_grad()
    def reset_parameters(
        self, generator: torch.Generator | Sequence[torch.Generator] | None = None
    ) -> None:
        """Draw the weights anew, from generators as those of the class."""
        # One generator draws all layers at once, several draw one layer each.
        n_draws = self.batch_size.numel() if isinstance(generator, Sequence) else 1
        streams, bound = one_each(generator, n_draws), 1 / math.sqrt(self.in_features)
        weights, biases = self.weight.view(n_draws, -1), self.bias.view(n_draws, -1)
        for weight, bias, stream in zip(weights, biases, streams, strict=True):
            weight.uniform_(-bound, bound, generator=stream)
            bias.uniform_(-bound, bound, generator=stream)

    @property
    def batch_size(self) -> torch.Size:
        """Leading dimensions ``S`` of the weights."""
        return self.weight.shape[:-2]

    def forward(self, input: Tensor) -> Tensor:
        """Apply each layer to its own slice of the input.

        Args:
            input: ``[*S, *B, in_features]``; ``B`` may be of any length.

        Returns:
            ``[*S, *B, out_features]``.

        Raises:
            ValueError: If the input does not lead with ``S`` or has another number of features.
        """
        return self.product(self.rows(input)).reshape(*input.shape[:-1], self.out_features)

    def rows(self, input: Tensor) -> Tensor:
        """Return an input of `forward` as ``[N, rows, in_features]``, with ``N`` layers in all."""
        stack = self.batch_size
        if input.shape[-1] != self.in_features or input.shape[: len(stack)] != stack:
            raise ValueError(
                "the input must have one leading index per layer and "
                f"{self.in_features} features, shape {[*stack]} + [*B, {self.in_features}], got "
                f"{[*input.shape]}"
            )
        return input.reshape(stack.numel(), -1, self.in_features)

    def product(self, rows: Tensor) -> Tensor:
        """Apply the ``N`` layers to `rows`; return ``[N, rows, out_features]``."""
        weight = self.weight.reshape(-1, self.in_features, self.out_features)
        bias = self.bias.reshape(-1, 1, self.out_features)
        # Products with few columns are slow: one column is a weighted sum, and few are faster as
        # rows, unless a gradient follows, which would then have the rows in its last dimension.
        if self.out_features == 1:
            return (rows * weight.mT).sum(-1, keepdim=True) + bias
        if self.out_features <= 16 and not torch.is_grad_enabled():
            return torch.baddbmm(bias.mT, weight.mT, rows.mT).mT
        return torch.baddbmm(bias, rows, weight)


class StackedMLP(nn.Module):
    """Perceptron of `StackedLinear` layers with ReLU between them.

    With ``layer_norm``, each hidden layer's output is normalized over its units (Ba et al., 2016,
    without gain and bias) before the ReLU. In a Q-function this bounds the values of actions that
    no transition contains (Ball et al., 2023, "Efficient Online Reinforcement Learning with Offline
    Data").

    Args:
        in_features: Size of the last input dimension.
        out_features: Size of the last output dimension.
        hidden_sizes: Width of each hidden layer.
        layer_norm: Whether to normalize the hidden layers.
        batch_size: Leading dimensions ``S`` of the weights.
        generator: As in `StackedLinear`.

    Examples:
        >>> mlp = StackedMLP(96, 4)
        >>> mlp(torch.zeros(256, 96)).shape
        torch.Size([256, 4])
    """

    def __init__(
        self,
        in_features: int,
        out_features: int,
        *,
        hidden_sizes: Sequence[int] = RLConfig.hidden_sizes,
        layer_norm: bool = False,
        batch_size: int | Sequence[int] = (),
        generator: torch.Generator | Sequence[torch.Generator] | None = None,
    ) -> None:
        super().__init__()
        self.layer_norm = layer_norm
        sizes = [in_features, *hidden_sizes, out_features]
        self.layers = nn.ModuleList(
            StackedLinear(n_in, n_out, batch_size, generator) for n_in, n_out in pairwise(sizes)
        )

    @property
    def batch_size(self) -> torch.Size:
        """Leading dimensions ``S`` of the weights."""
        return cast(StackedLinear, self.layers[0]).batch_size

    def forward(self, input: Tensor) -> Tensor:
        """Return the output ``[*S, *B, out_features]``; input as for `StackedLinear`."""
        first, *others = cast(list[StackedLinear], self.layers)
        # The stack is flattened once: a ReLU in place on a view would copy its gradient.
        x = first.product(first.rows(input))
        for layer in others:
            if self.layer_norm:
                x = F.layer_norm(x, x.shape[-1:])
            x = layer.product(x.relu_())
        return x.reshape(*input.shape[:-1], x.shape[-1])
