"""Policies with a Gaussian over actions: that of SAC, and one with a head for each task."""

from __future__ import annotations

import math
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

__all__ = ["LOG_SCALE_BOUNDS", "GaussianActor", "MultiHeadActor"]

LOG_SCALE_BOUNDS = (-5.0, 2.0)
"""Lowest and highest logarithm of the scale, as in CleanRL's SAC."""


class GaussianActor(StackedNetwork):
    """Stochastic policy: an MLP for mean and scale of a Gaussian that is squashed by a tanh.

    (Haarnoja et al., 2018.) A call acts without noise: it reads ``in_keys`` and writes ``"loc"``
    and ``"scale"`` ``[*S, *B, action_dim]``, and ``"action"``, ``tanh(loc)``. `sample` draws
    actions from given noise. Arguments as for `Actor`.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> actor = GaussianActor(3, 2, in_keys=["state"])
        >>> drawn = actor.sample(TensorDict({"state": torch.zeros(7, 3)}, 7), torch.randn(7, 2))
        >>> drawn["action"].shape, drawn["action_log_prob"].shape
        (torch.Size([7, 2]), torch.Size([7]))
    """

    def __init__(
        self,
        in_features: int,
        action_dim: int = 4,
        *,
        in_keys: Sequence[NestedKey] = ("latent", "behavior"),
        **mlp: Any,
    ) -> None:
        super().__init__(in_keys, ["loc", "scale", "action"])
        self.action_dim = action_dim
        self.mlp = StackedMLP(in_features, 2 * action_dim, **mlp)

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the actions without noise; return the same tensordict."""
        loc, log_scale = self.mlp(self.input(tensordict)).chunk(2, dim=-1)
        tensordict.set("loc", loc)
        tensordict.set("scale", log_scale.clamp(*LOG_SCALE_BOUNDS).exp())
        return tensordict.set("action", loc.tanh())

    def sample(self, tensordict: TensorDictBase, noise: Tensor) -> TensorDictBase:
        """Draw actions of states: `forward`, then `draw`."""
        return self.draw(self(tensordict), noise)

    @staticmethod
    def draw(tensordict: TensorDictBase, noise: Tensor) -> TensorDictBase:
        """Draw actions from ``"loc"`` and ``"scale"``, differentiable with respect to both.

        Writes ``"action"`` and ``"action_log_prob"`` ``[*S, *B]``, the log density of the action.
        ``noise`` holds standard normals ``[*S, *B, action_dim]``.
        """
        scale: Tensor = tensordict["scale"]
        pre_tanh: Tensor = tensordict["loc"] + scale * noise
        log_prob = -0.5 * (noise.square() + math.log(2 * math.pi)) - scale.log()
        # log(1 - tanh(x)^2), in a form that holds for large x.
        log_prob = log_prob - 2 * (math.log(2) - pre_tanh - F.softplus(pre_tanh * -2))
        tensordict.set("action_log_prob", log_prob.sum(-1))
        return tensordict.set("action", pre_tanh.tanh())


# Teachers are deterministic: without a lowest scale, the likelihood of their actions, and with it
# the gradient, would grow without bound.
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
        hidden = self.trunk(self.input(tensordict)).relu()
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
