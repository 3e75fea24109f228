"""Variational autoencoder with an inverse model: one camera frame to a 64-number latent.

Section IV-A of the paper fixes the layers; Section III-A the joint objective, which lives in
:mod:`bgpo_trl.objectives.representation`.
"""

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


class VAE(nn.Module):
    """Convolutional VAE over 64x32 RGB frames, with a one-layer inverse model on its latents.

    The encoder has three 3x3 convolutions of 32, 64 and 128 channels, each followed by ReLU and
    2x2 max-pooling, then two parallel dense layers for mean and log-variance. The decoder mirrors
    it with three transposed convolutions (kernel 4, stride 2: every "upsample by 2, then 3x3
    convolution" is one of these, at half the compute) and a sigmoid output. Everything runs
    channels-last, which is the layout the frames already have.

    A fixed camera shows mostly the same table. So both ends work relative to a mean frame: it is
    subtracted from what the encoder reads, and it is what the decoder shows when its last layer
    says nothing. This is input normalisation and an output bias, nothing else, but it spares the
    network hundreds of steps of learning the background before it turns to the objects.

    Args:
        latent_size: dimensions of z (paper: 64).
        action_size: dimensions of an action (paper: 4).

    Raises:
        ValueError: if a size is not positive.

    Attributes:
        mean_frame: ``[32, 64, 3]`` buffer in [0, 1], set before training; grey until then.
        latent_mean: ``[latent_size]`` buffer, subtracted from mu by :meth:`latent`.
        latent_std: ``[latent_size]`` buffer, divides mu in :meth:`latent`.

    Example:
        >>> import torch
        >>> vae = VAE()
        >>> frames = torch.zeros(10, 32, 64, 3, dtype=torch.uint8)
        >>> vae.latent(frames).shape
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
        # Starts with little noise (sigma .14): as loud as the signal, it would first teach the
        # decoder to ignore z.
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
        """Return the posterior's mean and log-variance.

        Args:
            pixels: uint8 ``[..., 32, 64, 3]``.

        Returns:
            ``mu`` and ``log_variance``, float32 ``[..., latent_size]`` each.

        Raises:
            ValueError: if ``pixels`` is not uint8 or not of that shape.
        """
        coarse = self._coarse(pixels)
        return self.mean_head(coarse), self.log_variance_head(coarse)

    def decode(self, z: Tensor) -> Tensor:
        """Return the reconstructed frames in [0, 1].

        Args:
            z: ``[..., latent_size]``, on the scale of mu (not of :meth:`latent`).

        Returns:
            float32 ``[..., 32, 64, 3]``.

        Raises:
            ValueError: if ``z`` has another size.
        """
        self._check_latent(z)
        x = F.relu(self.decoder_dense(z.reshape(-1, self.latent_size)))
        x = x.unflatten(-1, _COARSE_SHAPE).contiguous(memory_format=torch.channels_last)
        for convolution in self.decoder[:-1]:
            x = F.relu(convolution(x))
        # The bound keeps pixels that are nearly always black or white able to change.
        x = self.decoder[-1](x).permute(0, 2, 3, 1) + torch.logit(self.mean_frame, eps=0.02)
        return torch.sigmoid(x).reshape(*z.shape[:-1], *FRAME_SHAPE)

    def inverse(self, z: Tensor, z_next: Tensor) -> Tensor:
        """Predicts the action taken between two consecutive latents.

        Args:
            z: ``[..., latent_size]``, on the scale of mu.
            z_next: ``[..., latent_size]``, one step later.

        Returns:
            float32 ``[..., action_size]`` in (-1, 1).

        Raises:
            ValueError: if a latent has another size.
        """
        self._check_latent(z)
        self._check_latent(z_next)
        return torch.tanh(self.inverse_head(torch.cat([z, z_next], -1)))

    @torch.no_grad()
    def latent(self, pixels: Tensor) -> Tensor:
        """Return the feature vector used downstream: mu, standardised. Carries no gradient.

        Args:
            pixels: uint8 ``[..., 32, 64, 3]``.

        Returns:
            float32 ``[..., latent_size]``, about zero mean and unit variance on training frames.

        Raises:
            ValueError: as :meth:`encode`.
        """
        return self.standardize(self.mean_head(self._coarse(pixels)))

    def standardize(self, mu: Tensor) -> Tensor:
        """Return ``(mu - latent_mean) / latent_std``, ``[..., latent_size]``."""
        return (mu - self.latent_mean) / self.latent_std

    @torch.no_grad()
    def set_latent_scale(self, mu: Tensor, floor: float = 0.1) -> None:
        """Set the buffers that :meth:`latent` standardises with.

        Dimensions that the KL term switched off keep a tiny, meaningless spread. Dividing by it
        would blow that up into noise of the size of the signal, so no dimension is divided by
        less than ``floor`` times the largest standard deviation.

        Args:
            mu: ``[N, latent_size]``, means of the training frames.
            floor: the smallest divisor, relative to the largest standard deviation.

        Raises:
            ValueError: if ``mu`` has fewer than two rows, or is constant or not finite.
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
        if pixels.dtype != torch.uint8 or pixels.shape[-3:] != FRAME_SHAPE:
            raise ValueError(
                f"pixels must be uint8 [..., 32, 64, 3], got {pixels.dtype} {tuple(pixels.shape)}"
            )
        x = (pixels.reshape(-1, *FRAME_SHAPE) / 255 - self.mean_frame).permute(0, 3, 1, 2)
        for convolution in self.encoder:
            # Pooling before ReLU gives the same result (both are monotone) on a quarter the data.
            x = F.relu(F.max_pool2d(convolution(x), 2))
        return x.reshape(*pixels.shape[:-3], _COARSE_SIZE)
