"""A policy with a shared trunk and one Gaussian head a task, to be distilled from teachers."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import Tensor, nn

from bgpo_trl.modules.actor_critic import StackedLinear, StackedMLP
from bgpo_trl.modules.entries import read

__all__ = ["MultiHeadActor"]

# A teacher is deterministic, so nothing else keeps the likelihood of its actions from growing
# without bound, and the steps towards them with it.
_MIN_SCALE, _MAX_SCALE = 0.1, 1.0


class MultiHeadActor(TensorDictModuleBase):
    """Maps the states of each task to a Gaussian over actions, by the head of that task.

    Reads ``in_keys`` (``[*S, T, *B, features]`` each, ``T`` the number of heads) and writes
    ``"loc"`` in [-1, 1] and ``"scale"`` in [0.1, 1], ``[*S, T, *B, action_dim]``, the mean and the
    standard deviation, and ``"action"``, which is the mean.

    Args:
        in_features: size of all ``in_keys`` together.
        action_dim: number of action components.
        in_keys: entries to read, concatenated in this order.
        hidden_sizes: width of each layer of the trunk, at least one.
        batch_size: leading dimensions ``S`` of the weights, one independent policy for each index.
        generator: source of the trunk's initial weights, as in `StackedLinear`.

    Examples:
        >>> from tensordict import TensorDict
        >>> actor = MultiHeadActor(64)
        >>> _ = actor.add_head()
        >>> _ = actor.add_head()
        >>> actor(TensorDict({"latent": torch.zeros(2, 5, 64)}, [2, 5]))["action"].shape
        torch.Size([2, 5, 4])
    """

    in_keys: list[NestedKey]

    def __init__(
        self,
        in_features: int,
        action_dim: int = 4,
        *,
        in_keys: Sequence[NestedKey] = ("latent",),
        hidden_sizes: Sequence[int] = (64,),
        batch_size: Sequence[int] = (),
        generator: torch.Generator | Sequence[torch.Generator] | None = None,
    ) -> None:
        super().__init__()
        if not hidden_sizes:
            raise ValueError("hidden_sizes is empty: heads need a trunk of at least one layer")
        self.in_keys = list(in_keys)
        self.out_keys = ["loc", "scale", "action"]
        self.batch_size = torch.Size(batch_size)
        self.action_dim = action_dim
        *inner, self._width = hidden_sizes
        self.trunk = StackedMLP(
            in_features,
            self._width,
            hidden_sizes=inner,
            batch_size=batch_size,
            generator=generator,
        )
        self.heads = nn.ModuleList()

    def add_head(
        self, generator: torch.Generator | Sequence[torch.Generator] | None = None
    ) -> StackedLinear:
        """Add the head of a further task; the trunk and the other heads stay as they are.

        Args:
            generator: source of its initial weights, as in `StackedLinear`.

        Returns:
            The head, so that an optimizer can be told of its parameters.
        """
        head = StackedLinear(self._width, 2 * self.action_dim, self.batch_size, generator)
        reference = next(self.trunk.parameters())
        self.heads.append(head.to(reference.device, reference.dtype))
        return head

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the distribution of actions for each state.

        Args:
            tensordict: with ``in_keys``; ``"loc"``, ``"scale"`` and ``"action"`` are set in it.

        Returns:
            The same tensordict.

        Raises:
            ValueError: if an entry is missing, or the states are not of as many tasks as there are
                heads.
        """
        hidden = self.trunk(*read(self, tensordict)).relu()
        task_dim = len(self.batch_size)
        if hidden.shape[task_dim] != len(self.heads):
            raise ValueError(
                f"states of {hidden.shape[task_dim]} tasks for {len(self.heads)} heads: add a head "
                "for each task"
            )
        told: list[Tensor] = [
            head(of_task) for head, of_task in zip(self.heads, hidden.unbind(task_dim), strict=True)
        ]
        loc, scale = torch.stack(told, task_dim).chunk(2, -1)
        loc, share = loc.tanh(), scale.sigmoid()
        scale = _MIN_SCALE * (_MAX_SCALE / _MIN_SCALE) ** share
        return tensordict.set("loc", loc).set("scale", scale).set("action", loc)
