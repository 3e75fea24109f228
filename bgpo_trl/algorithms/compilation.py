"""Losses and gradients of a learner, compiled."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

__all__ = ["CompiledGradients"]

Losses = dict[str, Tensor]


class CompiledGradients:
    """A learner's losses and their gradients, as one compiled function of a batch.

    For each shape of a batch, losses and gradients are traced once, into a graph of tensor
    operations without TensorDicts and without autograd, which ``torch.compile`` then compiles.
    PyTorch caches the compiled code between runs. Without a C++ compiler, the graph is used as it
    is, with a warning.

    The graph reads the current values of parameters, targets and other tensors of the loss as long
    as these are changed in place. Choices that the loss makes in Python stay as they were when it
    was traced, and noise from a ``torch.Generator`` cannot be traced.

    Args:
        losses: Returns entries ``[S, E]`` to minimize for transitions ``[S, E, B]``.
        parameters: What is learned.
    """

    def __init__(
        self, losses: Callable[[TensorDictBase], Losses], parameters: Sequence[Tensor]
    ) -> None:
        self.losses, self.parameters = losses, [*parameters]
        self._functions: dict[Any, Callable[[Losses], tuple[list[Tensor], Losses]]] = {}

    def __call__(self, batch: TensorDictBase) -> Losses:
        """Set the gradients of the parameters and return the losses ``[S, E]``, detached."""
        entries: Any = dict(batch.items(True, True))
        shapes = tuple((key, value.shape) for key, value in entries.items())
        with torch.no_grad():
            if shapes not in self._functions:
                self._functions[shapes] = self._compiled(entries, batch.batch_size)
            gradients, losses = self._functions[shapes](entries)
        for parameter, gradient in zip(self.parameters, gradients, strict=True):
            parameter.grad = gradient
        return losses

    def _compiled(self, entries: Losses, batch_size: torch.Size) -> Callable[..., Any]:
        # Imported here since runs without compilation need none of it.
        from torch.fx.experimental.proxy_tensor import make_fx

        def losses_and_gradients(entries: dict[NestedKey, Tensor]) -> tuple[list[Tensor], Losses]:
            with torch.enable_grad():
                losses = self.losses(TensorDict(entries, batch_size))
                total = torch.stack([loss.sum() for loss in losses.values()]).sum()
                gradients = torch.autograd.grad(total, self.parameters)
            return [*gradients], {key: loss.detach() for key, loss in losses.items()}

        graph = make_fx(losses_and_gradients)(entries)
        graph.graph.eliminate_dead_code()
        graph.recompile()
        compiled = torch.compile(graph, dynamic=False)
        try:
            compiled(entries)
        except RuntimeError as error:  # an error of the graph itself will be raised again
            reason = str(error).splitlines()[0]
            warnings.warn(f"updates are traced, but not compiled: {reason}", stacklevel=2)
            return graph
        return compiled
