"""Stochastic policy of SAC."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch.nn.functional as F
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import dispatch
from torch import Tensor

from bgpo_trl.modules.actor_critic import StackedNetwork
from bgpo_trl.modules.stacked_mlp import StackedMLP

__all__ = ["LOG_SCALE_BOUNDS", "GaussianActor"]

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
