"""Variational autoencoder with an inverse model: from a camera frame to a 64-dimensional latent."""

from __future__ import annotations

from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

FRAME_SHAPE = (32, 64, 3)
"""Height, width and channels of a frame (Sec. IV-A: "a 64x32 RGB image")."""

_CHANNELS = (3, 32, 64, 128)
_COARSE_SHAPE = (128, 4, 8)
_COARSE_SIZE = 4096
# On a CPU, activations of more frames do not fit into the cache, and take twice as long.
_FRAMES_AT_ONCE = 64


class VAE(nn.Module):
    """Convolutional VAE over 64x32 RGB frames, with a one-layer inverse model on its latents.

    Encoder (Sec. IV-A): three 3x3 convolutions of 32, 64 and 128 channels, each followed by 2x2
    max-pooling and ReLU, then one dense layer each for mean and log-variance. Decoder: the mirror
    image, with transposed convolutions (kernel 4, stride 2) in place of "upsample by 2, then 3x3
    convolution", at half the compute, and a sigmoid output. Both work on the difference to a mean
    frame: the fixed camera mostly shows the same table, which would take hundreds of steps to
    learn.

    Frames are uint8 ``[..., 32, 64, 3]``, and tensors channels-last like them. Latents are
    ``[..., latent_size]``, on the scale of mu unless they come from `latent`.

    Args:
        latent_size: Dimensions of z (paper: 64).
        action_size: Dimensions of an action (paper: 4).

    Raises:
        ValueError: If a size is not positive; from methods, if frames have another dtype or shape,
            or latents another size.

    Attributes:
        mean_frame: Buffer ``[32, 64, 3]`` in [0, 1], set before training; grey until then.
        latent_mean: Buffer ``[latent_size]``, subtracted from mu by `latent`.
        latent_std: Buffer ``[latent_size]``, by which `latent` divides.

    Example:
        >>> frames = torch.zeros(10, 32, 64, 3, dtype=torch.uint8)
        >>> VAE().latent(frames).shape
        torch.Size([10, 64])
    """

    mean_frame: Tensor
    latent_mean: Tensor
    latent_std: Tensor

    def __init__(self, latent_size: int = 64, action_size: int = 4) -> None:
        if latent_size < 1 or action_size < 1:
            raise ValueError(
                f"latent_size and action_size must be at least 1, got {latent_size} and "
                f"{action_size}"
            )
        super().__init__()
        self.latent_size = latent_size
        self.action_size = action_size
        self.encoder = nn.ModuleList(nn.Conv2d(a, b, 3, padding=1) for a, b in pairwise(_CHANNELS))
        self.mean_head = nn.Linear(_COARSE_SIZE, latent_size)
        self.log_variance_head = nn.Linear(_COARSE_SIZE, latent_size)
        # Little noise at first (sigma 0.14): with noise as large as the signal, the decoder would
        # learn to ignore z.
        nn.init.zeros_(self.log_variance_head.weight)
        nn.init.constant_(self.log_variance_head.bias, -4.0)
        self.decoder_dense = nn.Linear(latent_size, _COARSE_SIZE)
        self.decoder = nn.ModuleList(
            nn.ConvTranspose2d(b, a, 4, stride=2, padding=1)
            for b, a in pairwise(reversed(_CHANNELS))
        )
        self.inverse_head = nn.Linear(2 * latent_size, action_size)
        self.register_buffer("mean_frame", torch.full(FRAME_SHAPE, 0.5))
        self.register_buffer("latent_mean", torch.zeros(latent_size))
        self.register_buffer("latent_std", torch.ones(latent_size))
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def encode(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and log-variance of the posterior, float32 ``[..., latent_size]`` each."""
        coarse = self._coarse(pixels)
        return self.mean_head(coarse), self.log_variance_head(coarse)

    def decode(self, z: Tensor) -> Tensor:
        """Return reconstructed frames, float32 ``[..., 32, 64, 3]`` in [0, 1]."""
        self._check_latent(z)
        x = F.relu(self.decoder_dense(z.reshape(-1, self.latent_size)))
        x = x.unflatten(-1, _COARSE_SHAPE).contiguous(memory_format=torch.channels_last)
        for convolution in self.decoder[:-1]:
            x = F.relu(convolution(x))
        # eps: without it, pixels that are nearly always black or white could not change.
        x = self.decoder[-1](x).permute(0, 2, 3, 1) + torch.logit(self.mean_frame, eps=0.02)
        return torch.sigmoid(x).reshape(*z.shape[:-1], *FRAME_SHAPE)

    def inverse(self, z: Tensor, z_next: Tensor) -> Tensor:
        """Predict the action between consecutive latents, ``[..., action_size]`` in (-1, 1)."""
        self._check_latent(z)
        self._check_latent(z_next)
        return torch.tanh(self.inverse_head(torch.cat([z, z_next], -1)))

    @torch.no_grad()
    def latent(self, pixels: Tensor) -> Tensor:
        """Return the features used downstream: mu, standardized, ``[..., latent_size]``."""
        _check_frames(pixels)
        frames = pixels.reshape(-1, *FRAME_SHAPE)
        parts = frames.split(_FRAMES_AT_ONCE) if frames.device.type == "cpu" else (frames,)
        mu = torch.cat([self.mean_head(self._coarse(part)) for part in parts])
        return self.standardize(mu).reshape(*pixels.shape[:-3], self.latent_size)

    def standardize(self, mu: Tensor) -> Tensor:
        """Return ``(mu - latent_mean) / latent_std``, ``[..., latent_size]``."""
        return (mu - self.latent_mean) / self.latent_std

    @torch.no_grad()
    def set_latent_scale(self, mu: Tensor, floor: float = 0.1) -> None:
        """Set mean and standard deviation of `latent` from the mu ``[N, latent_size]`` of frames.

        The KL term switches dimensions off: they keep a tiny spread, and dividing by it would turn
        them into noise as large as the signal. No divisor is below ``floor`` times the largest.

        Raises:
            ValueError: If ``mu`` has fewer than two rows, or is constant or not finite.
        """
        if mu.ndim != 2 or mu.shape[0] < 2:
            raise ValueError(f"mu must be [N, {self.latent_size}], N >= 2, got {tuple(mu.shape)}")
        std, mean = torch.std_mean(mu, 0)
        if not (std.isfinite().all() and std.max() > 0):
            raise ValueError("mu is constant or not finite: train the VAE (again) before scaling")
        self.latent_mean.copy_(mean)
        self.latent_std.copy_(std.clamp_min(floor * std.max()))

    def _check_latent(self, z: Tensor) -> None:
        if z.shape[-1:] != (self.latent_size,):
            raise ValueError(f"a latent must be [..., {self.latent_size}], got {[*z.shape]}")

    def _coarse(self, pixels: Tensor) -> Tensor:
        _check_frames(pixels)
        x = pixels.reshape(-1, *FRAME_SHAPE).to(self.mean_frame.dtype) / 255 - self.mean_frame
        x = x.permute(0, 3, 1, 2)
        for convolution in self.encoder:
            # Pooling before ReLU gives the same result (both are monotone), at a quarter the size.
            x = F.relu(F.max_pool2d(convolution(x), 2))
        return x.reshape(*pixels.shape[:-3], _COARSE_SIZE)


def _check_frames(pixels: Tensor) -> None:
    if pixels.dtype != torch.uint8 or pixels.shape[-3:] != FRAME_SHAPE:
        raise ValueError(
            f"pixels must be uint8 [..., 32, 64, 3], got {pixels.dtype} {tuple(pixels.shape)}"
        )
