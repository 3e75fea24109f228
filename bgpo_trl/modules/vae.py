"""Variational autoencoder with an inverse model: from a camera frame to a 64-dimensional latent."""

from __future__ import annotations

import math
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

FRAME_SHAPE = (32, 64, 3)
"""Height, width and channels of a frame (Sec. IV-A: "a 64x32 RGB image")."""

_CHANNELS = (3, 32, 64, 128)
_COARSE_SHAPE = (128, 4, 8)
_COARSE_SIZE = 4096
_MAP_SHAPE = (16, 32)
# Half the height and width of the map of keypoints, in the unit of its coordinates.
_MAP_REACH = (1.0, 2.0)
# Coordinates are multiplied by these, to have the scale of the other dimensions.
_COORDINATE_SCALE = (3.0, 1.5)
# Standard deviation of the blobs that the decoder draws at keypoints: a little more than a cell.
_BLOB = 0.16
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

    Half of the latent's dimensions are coordinates of keypoints: the mean of each is the expected
    position under the softmax of a feature map (Finn et al., 2016), and the decoder draws a blob
    there (Jakab et al., 2018). The paper has none; a dense layer alone encodes places in a way from
    which a policy learns to read them more slowly (docs/learning.md).

    Frames are uint8 ``[..., 32, 64, 3]``, and tensors channels-last like them. Latents are
    ``[..., latent_size]``, on the scale of mu unless they come from `latent`.

    Args:
        latent_size: Dimensions of z (paper: 64); a quarter of it, rounded down, is the number of
            keypoints.
        action_size: Dimensions of an action (paper: 4).

    Raises:
        ValueError: If there is no action, or no keypoint; from methods, if frames have another
            dtype or shape, or latents another size.

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
        if latent_size < 4 or action_size < 1:
            raise ValueError(
                f"latent_size must be at least 4 and action_size at least 1, got {latent_size} and "
                f"{action_size}"
            )
        super().__init__()
        self.latent_size = latent_size
        self.action_size = action_size
        self.encoder = nn.ModuleList(nn.Conv2d(a, b, 3, padding=1) for a, b in pairwise(_CHANNELS))
        self.n_keypoints = latent_size // 4
        self.keypoint_maps = nn.Conv2d(_CHANNELS[2], self.n_keypoints, 1)
        self.log_sharpness = nn.Parameter(torch.full((self.n_keypoints, 1, 1), math.log(3.0)))
        self.mean_head = nn.Linear(_COARSE_SIZE, latent_size - 2 * self.n_keypoints)
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
        self.place = nn.Conv2d(_CHANNELS[1] + self.n_keypoints, _CHANNELS[1], 3, padding=1)
        self.inverse_head = nn.Linear(2 * latent_size, action_size)
        self.register_buffer("mean_frame", torch.full(FRAME_SHAPE, 0.5))
        self.register_buffer("latent_mean", torch.zeros(latent_size))
        self.register_buffer("latent_std", torch.ones(latent_size))
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def encode(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and log-variance of the posterior, float32 ``[..., latent_size]`` each."""
        _check_frames(pixels)
        mu, coarse = self._mean(pixels.reshape(-1, *FRAME_SHAPE))
        shape = *pixels.shape[:-3], self.latent_size
        return mu.reshape(shape), self.log_variance_head(coarse).float().reshape(shape)

    def decode(self, z: Tensor) -> Tensor:
        """Return reconstructed frames, float32 ``[..., 32, 64, 3]`` in [0, 1]."""
        self._check_latent(z)
        flat = z.reshape(-1, self.latent_size)
        x = F.relu(self.decoder_dense(flat))
        x = x.unflatten(-1, _COARSE_SHAPE).contiguous(memory_format=torch.channels_last)
        for convolution in self.decoder[:-1]:
            x = F.relu(convolution(x))
        x = torch.cat([x, self._blobs(flat).to(x.dtype)], 1)
        x = F.relu(self.place(x.contiguous(memory_format=torch.channels_last)))
        # eps: without it, pixels that are nearly always black or white could not change.
        x = self.decoder[-1](x).permute(0, 2, 3, 1) + torch.logit(self.mean_frame, eps=0.02)
        return torch.sigmoid(x.float()).reshape(*z.shape[:-1], *FRAME_SHAPE)

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
        mu = torch.cat([self._mean(part)[0] for part in parts])
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

    def _mean(self, frames: Tensor) -> tuple[Tensor, Tensor]:
        """Return mu ``[N, latent_size]`` and the features ``[N, 4096]`` of frames ``[N, ...]``."""
        x = frames.to(self.mean_frame.dtype) / 255 - self.mean_frame
        first, second, third = self.encoder
        # Pooling before ReLU gives the same result (both are monotone), at a quarter the size.
        x = F.relu(F.max_pool2d(first(x.permute(0, 3, 1, 2)), 2))
        fine = F.relu(second(x))
        coarse = F.relu(F.max_pool2d(third(F.max_pool2d(fine, 2)), 2)).flatten(1)
        maps = self.log_sharpness.exp() * self.keypoint_maps(fine)
        weight = maps.flatten(2).to(self.mean_frame.dtype).softmax(-1).unflatten(2, _MAP_SHAPE)
        row, column = self._grid()
        x, y = (weight.sum(2) * column).sum(-1), (weight.sum(3) * row).sum(-1)
        coordinates = torch.cat([_COORDINATE_SCALE[1] * x, _COORDINATE_SCALE[0] * y], -1)
        return torch.cat([coordinates, self.mean_head(coarse).to(coordinates.dtype)], -1), coarse

    def _blobs(self, z: Tensor) -> Tensor:
        """Return a blob at each keypoint of latents ``[N, latent_size]``, ``[N, K, 16, 32]``."""
        x, y = z[:, : 2 * self.n_keypoints].unsqueeze(-1).chunk(2, 1)
        row, column = self._grid()
        across = (x / _COORDINATE_SCALE[1] - column).square() / (2 * _BLOB**2)
        along = (y / _COORDINATE_SCALE[0] - row).square() / (2 * _BLOB**2)
        return (-along).exp().unsqueeze(-1) * (-across).exp().unsqueeze(-2)

    def _grid(self) -> tuple[Tensor, Tensor]:
        """Return the coordinates of the map's rows ``[16]`` and columns ``[32]``."""
        like = {"dtype": self.mean_frame.dtype, "device": self.mean_frame.device}
        row, column = (
            torch.linspace(-reach, reach, size, **like)
            for reach, size in zip(_MAP_REACH, _MAP_SHAPE, strict=True)
        )
        return row, column


def _check_frames(pixels: Tensor) -> None:
    if pixels.dtype != torch.uint8 or pixels.shape[-3:] != FRAME_SHAPE:
        raise ValueError(
            f"pixels must be uint8 [..., 32, 64, 3], got {pixels.dtype} {tuple(pixels.shape)}"
        )
