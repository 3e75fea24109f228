"""Policy with a Gaussian over actions and a head for each task."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import dispatch
from torch import Tensor, nn

from bgpo_trl.configs import RLConfig
from bgpo_trl.modules.actor_critic import StackedNetwork
from bgpo_trl.modules.stacked_mlp import StackedLinear, StackedMLP

_MIN_SCALE, _MAX_SCALE = 0.1, 1.0


class MultiHeadActor(StackedNetwork):
    """Policy with a Gaussian over actions for each task, from that task's head on a shared trunk.

    Reads ``in_keys`` (``[*S, T, *B, features]`` each, ``T`` the number of heads) and writes mean
    ``"loc"`` in [-1, 1] and standard deviation ``"scale"`` in [0.1, 1],
    ``[*S, T, *B, action_dim]``, and ``"action"``, the mean. Arguments as for `Actor`;
    ``hidden_sizes`` are the layers of the trunk.

    Raises:
        ValueError: If the trunk has no layer; from ``forward``, if an entry is missing or the
            number of tasks is not that of heads.

    Examples:
        >>> from tensordict import TensorDict
        >>> actor = MultiHeadActor(64)
        >>> _ = actor.add_head()
        >>> _ = actor.add_head()
        >>> actor(TensorDict({"latent": torch.zeros(2, 5, 64)}, [2, 5]))["action"].shape
        torch.Size([2, 5, 4])
    """

    def __init__(
        self,
        in_features: int,
        action_dim: int = 4,
        *,
        in_keys: Sequence[NestedKey] = ("latent",),
        hidden_sizes: Sequence[int] = RLConfig.hidden_sizes,
        **mlp: Any,
    ) -> None:
        if not hidden_sizes:
            raise ValueError("hidden_sizes is empty: heads need a trunk of at least one layer")
        super().__init__(in_keys, ["loc", "scale", "action"])
        self.action_dim = action_dim
        *inner, self._width = hidden_sizes
        self.trunk = StackedMLP(in_features, self._width, hidden_sizes=inner, **mlp)
        self.heads = nn.ModuleList()

    def add_head(
        self, generator: torch.Generator | Sequence[torch.Generator] | None = None
    ) -> StackedLinear:
        """Add and return the head of a further task; trunk and other heads stay as they are.

        Its weights are drawn from ``generator``, as in `StackedLinear`. The caller gives its
        parameters to an optimizer.
        """
        head = StackedLinear(self._width, 2 * self.action_dim, self.batch_size, generator)
        reference = next(self.trunk.parameters())
        self.heads.append(head.to(reference.device, reference.dtype))
        return head

    def policy(self, head: int) -> dict[str, Tensor]:
        """Return the weights of the `Actor` that acts as a head does on average, by name."""
        layers = [*self.trunk.layers, self.heads[head]]
        weights = {
            f"mlp.layers.{number}.{name}": value.detach()
            for number, layer in enumerate(layers)
            for name, value in layer.named_parameters()
        }
        last = f"mlp.layers.{len(layers) - 1}."
        return {
            key: value[..., : self.action_dim] if key.startswith(last) else value
            for key, value in weights.items()
        }

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the distributions of actions; return the same tensordict."""
        hidden = self.trunk(self.input(tensordict))
        if self.trunk.layer_norm:
            hidden = F.layer_norm(hidden, hidden.shape[-1:])
        hidden = hidden.relu()
        task_dim = len(self.batch_size)
        if hidden.shape[task_dim] != len(self.heads):
            raise ValueError(
                f"states of {hidden.shape[task_dim]} tasks for {len(self.heads)} heads: add a head "
                "for each task"
            )
        outputs: list[Tensor] = [
            head(of_task) for head, of_task in zip(self.heads, hidden.unbind(task_dim), strict=True)
        ]
        loc, scale = torch.stack(outputs, task_dim).chunk(2, -1)
        loc, share = loc.tanh(), scale.sigmoid()
        scale = _MIN_SCALE * (_MAX_SCALE / _MIN_SCALE) ** share
        return tensordict.set("loc", loc).set("scale", scale).set("action", loc)
