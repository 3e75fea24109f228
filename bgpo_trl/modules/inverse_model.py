"""Inverse model: the actions between the latents of somebody else's movement."""

from __future__ import annotations

import torch
from torch import Tensor, nn

_BEFORE, _AFTER = 3, 4  # latents of a window before and after the one in which the action is taken


class InverseModel(nn.Module):
    """Perceptron that infers an action from the latents around it.

    The VAE's own one-layer model (Sec. III-A) shapes the latents; from a pair of them it explains
    little of a slow movement, whose steps are hardly larger than the noise of a latent. This one,
    trained on frozen latents, reads windows of eight: the two between which the action leads, three
    before and three after. At the ends of an episode, the first and last latent repeat.

    Args:
        latent_size: Dimensions of a latent.
        action_size: Dimensions of an action.
        hidden_size: Units of each of the two hidden layers.

    Examples:
        >>> z, length = torch.randn(5, 51, 64), torch.tensor([51, 30, 2, 2, 40])
        >>> InverseModel()(z, length).shape
        torch.Size([5, 50, 4])
    """

    def __init__(self, latent_size: int = 64, action_size: int = 4, hidden_size: int = 512) -> None:
        super().__init__()
        self.action_size = action_size
        self.network = nn.Sequential(
            nn.Linear((_BEFORE + _AFTER + 1) * latent_size, hidden_size),
            nn.ReLU(),
            nn.Linear(hidden_size, hidden_size),
            nn.ReLU(),
            nn.Linear(hidden_size, action_size),
        )

    def forward(self, z: Tensor, length: Tensor) -> Tensor:
        """Infer the actions of whole episodes, ``[N, T - 1, action_size]`` in [-1, 1].

        Args:
            z: Latents ``[N, T, latent_size]``; values at or beyond ``length`` are ignored.
            length: Latents of each episode, int64 ``[N]`` in 1..T; later actions are undefined.
        """
        episode = torch.arange(len(z), device=z.device).unsqueeze(-1).expand(-1, z.shape[1] - 1)
        step = torch.arange(z.shape[1] - 1, device=z.device).expand_as(episode)
        return self.network(window(z, length, episode, step)).clamp(-1.0, 1.0)


def window(z: Tensor, length: Tensor, episode: Tensor, step: Tensor) -> Tensor:
    """Return the latents around steps of episodes, ``[..., 8 * latent_size]``.

    Args:
        z: Latents ``[N, T, latent_size]``.
        length: Latents of each episode, int64 ``[N]``.
        episode: Episodes, int64 ``[...]``.
        step: Step of each, int64 ``[...]``.
    """
    around = step.unsqueeze(-1) + torch.arange(-_BEFORE, _AFTER + 1, device=z.device)
    last = (length[episode] - 1).unsqueeze(-1)
    around = torch.minimum(around.clamp_min(0), last)
    return z[episode.unsqueeze(-1), around].flatten(-2)
