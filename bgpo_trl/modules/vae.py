"""Variational autoencoder with an inverse model: from a camera frame to a 64-dimensional latent."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from bgpo_trl.modules.frame_network import FrameNetwork

FRAME_SHAPE = (32, 64)
"""Height and width of a frame (Sec. IV-A: "a 64x32 RGB image")."""

_CHANNELS = (3, 32, 64, 128)
# Three poolings halve the frame.
_POOLED = 8
# Pixels in the unit of the coordinates of keypoints.
_UNIT = 16
# Coordinates at the border of the frame, on the scale of the other dimensions.
_LARGEST_COORDINATE = 3.0
# Standard deviation of the blobs that the decoder draws at keypoints: a little more than a cell.
_BLOB = 0.16


class VAE(FrameNetwork):
    """Convolutional VAE over RGB frames, with a one-layer inverse model on its latents.

    Encoder (Sec. IV-A): three 3x3 convolutions of 32, 64 and 128 channels, each followed by 2x2
    max-pooling and ReLU, then one dense layer each for mean and log-variance. Decoder: the mirror
    image, with transposed convolutions (kernel 4, stride 2) in place of "upsample by 2, then 3x3
    convolution", at half the compute, and a sigmoid output. Both work on the difference to a mean
    frame: the fixed camera mostly shows the same table, which would take hundreds of steps to
    learn.

    Half of the latent's dimensions are coordinates of keypoints: the mean of each is the expected
    position under the softmax of a feature map (Finn et al., 2016), and the decoder draws a blob
    there (Jakab et al., 2018). The paper has none; a dense layer alone encodes places in a way from
    which a policy learns to read them more slowly (docs/learning.md). Without keypoints, the dense
    layer gives all means, as in the paper.

    Frames are uint8 ``[..., H, W, 3]``, and tensors channels-last like them; height and width are
    padded to multiples of 8 inside. Latents are ``[..., latent_size]``, on the scale of mu unless
    they come from `latent`.

    Args:
        latent_size: Dimensions of z (paper: 64); a quarter of it, rounded down, is the number of
            keypoints.
        action_size: Dimensions of an action (paper: 4).
        frame_shape: Height and width of a frame, at least 16 each (paper: 32 and 64).
        keypoints: Whether there are keypoints.

    Raises:
        ValueError: If there is no action, latents are too small for a keypoint, or frames are too
            small; from methods, if frames have another dtype or shape, or latents another size.

    Attributes:
        mean_frame: Buffer ``[H, W, 3]`` in [0, 1], set before training; grey until then.

    Examples:
        >>> frames = torch.zeros(10, 32, 64, 3, dtype=torch.uint8)
        >>> VAE().latent(frames).shape
        torch.Size([10, 64])
    """

    identity = "vae 1"
    mean_frame: Tensor
    _row: Tensor
    _column: Tensor

    def __init__(
        self,
        latent_size: int = 64,
        action_size: int = 4,
        frame_shape: Sequence[int] = FRAME_SHAPE,
        keypoints: bool = True,
    ) -> None:
        if latent_size < 4 or action_size < 1:
            raise ValueError(
                f"latent_size must be at least 4 and action_size at least 1, got {latent_size} and "
                f"{action_size}"
            )
        super().__init__(latent_size, frame_shape)
        self.action_size = action_size
        self._padded = tuple(-(-size // _POOLED) * _POOLED for size in self.frame_shape)
        self._map_shape = (self._padded[0] // 2, self._padded[1] // 2)
        # Half the height and width of the map of keypoints, in the unit of its coordinates.
        self._map_reach = (self._map_shape[0] / _UNIT, self._map_shape[1] / _UNIT)
        self._coarse_shape = (_CHANNELS[3], *(size // _POOLED for size in self._padded))
        coarse_size = math.prod(self._coarse_shape)
        self.encoder = nn.ModuleList(nn.Conv2d(a, b, 3, padding=1) for a, b in pairwise(_CHANNELS))
        self.n_keypoints = latent_size // 4 if keypoints else 0
        if keypoints:
            self.keypoint_maps = nn.Conv2d(_CHANNELS[2], self.n_keypoints, 1)
            self.log_sharpness = nn.Parameter(torch.full((self.n_keypoints, 1, 1), math.log(3.0)))
        self.mean_head = nn.Linear(coarse_size, latent_size - 2 * self.n_keypoints)
        self.log_variance_head = nn.Linear(coarse_size, latent_size)
        # Little noise at first (sigma 0.14): with noise as large as the signal, the decoder would
        # learn to ignore z.
        nn.init.zeros_(self.log_variance_head.weight)
        nn.init.constant_(self.log_variance_head.bias, -4.0)
        self.decoder_dense = nn.Linear(latent_size, coarse_size)
        self.decoder = nn.ModuleList(
            nn.ConvTranspose2d(b, a, 4, stride=2, padding=1)
            for b, a in pairwise(reversed(_CHANNELS))
        )
        if keypoints:
            self.place = nn.Conv2d(_CHANNELS[1] + self.n_keypoints, _CHANNELS[1], 3, padding=1)
        self.inverse_head = nn.Linear(2 * latent_size, action_size)
        # Coordinates of the rows and columns of the map of keypoints.
        (height, width), (rows, columns) = self._map_reach, self._map_shape
        self.register_buffer("_row", torch.linspace(-height, height, rows), persistent=False)
        self.register_buffer("_column", torch.linspace(-width, width, columns), persistent=False)
        self.register_buffer("mean_frame", torch.full((*self.frame_shape, 3), 0.5))
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def encode(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and log-variance of the posterior, float32 ``[..., latent_size]`` each."""
        self.check_frames(pixels)
        mu, coarse = self._mean(pixels.reshape(-1, *pixels.shape[-3:]))
        shape = *pixels.shape[:-3], self.latent_size
        return mu.reshape(shape), self.log_variance_head(coarse).float().reshape(shape)

    def decode(self, z: Tensor) -> Tensor:
        """Return reconstructed frames, float32 ``[..., H, W, 3]`` in [0, 1]."""
        self._check_latent(z)
        flat = z.reshape(-1, self.latent_size)
        x = F.relu(self.decoder_dense(flat))
        x = x.unflatten(-1, self._coarse_shape).contiguous(memory_format=torch.channels_last)
        for convolution in self.decoder[:-1]:
            x = F.relu(convolution(x))
        if self.n_keypoints:
            x = torch.cat([x, self._blobs(flat).to(x.dtype)], 1)
            x = F.relu(self.place(x.contiguous(memory_format=torch.channels_last)))
        # eps: without it, pixels that are nearly always black or white could not change.
        height, width = self.frame_shape
        x = self.decoder[-1](x).permute(0, 2, 3, 1)[:, :height, :width]
        x = torch.sigmoid((x + torch.logit(self.mean_frame, eps=0.02)).float())
        return x.reshape(*z.shape[:-1], height, width, 3)

    def inverse(self, z: Tensor, z_next: Tensor) -> Tensor:
        """Predict the action between consecutive latents, ``[..., action_size]`` in (-1, 1)."""
        self._check_latent(z)
        self._check_latent(z_next)
        return torch.tanh(self.inverse_head(torch.cat([z, z_next], -1)))

    def features(self, frames: Tensor) -> Tensor:
        """Return mu of frames ``[N, H, W, 3]``, float32 ``[N, latent_size]``."""
        return self._mean(frames)[0]

    def _check_latent(self, z: Tensor) -> None:
        if z.shape[-1:] != (self.latent_size,):
            raise ValueError(f"a latent must be [..., {self.latent_size}], got {[*z.shape]}")

    def _mean(self, frames: Tensor) -> tuple[Tensor, Tensor]:
        """Return mu ``[N, latent_size]`` and the features ``[N, C]`` of frames ``[N, ...]``."""
        x = frames.to(self.mean_frame.dtype) / 255 - self.mean_frame
        if self._padded != self.frame_shape:
            below, right = (p - f for p, f in zip(self._padded, self.frame_shape, strict=True))
            x = F.pad(x, (0, 0, 0, right, 0, below))
        # Functions instead of calls of modules, which take a tenth of the time of a single frame.
        first, second, third = self.encoder
        # Pooling before ReLU gives the same result (both are monotone), at a quarter the size.
        x = F.max_pool2d(_convolution(x.permute(0, 3, 1, 2), first), 2).relu_()
        fine = _convolution(x, second).relu_()
        coarse = F.max_pool2d(_convolution(F.max_pool2d(fine, 2), third), 2).relu_().flatten(1)
        if not self.n_keypoints:
            return self.mean_head(coarse).to(self.mean_frame.dtype), coarse
        maps = self.log_sharpness.exp() * self.keypoint_maps(fine)
        weight = maps.flatten(2).to(self.mean_frame.dtype).softmax(-1).view(maps.shape)
        x, y = (weight.sum(2) * self._column).sum(-1), (weight.sum(3) * self._row).sum(-1)
        height, width = self._map_reach
        coordinates = torch.cat(
            [_LARGEST_COORDINATE / width * x, _LARGEST_COORDINATE / height * y], -1
        )
        return torch.cat([coordinates, self.mean_head(coarse).to(coordinates.dtype)], -1), coarse

    def _blobs(self, z: Tensor) -> Tensor:
        """Return a blob at each keypoint of latents ``[N, latent_size]``, ``[N, K, ...]``."""
        x, y = z[:, : 2 * self.n_keypoints].unsqueeze(-1).chunk(2, 1)
        height, width = (_LARGEST_COORDINATE / reach for reach in self._map_reach)
        across = (x / width - self._column).square() / (2 * _BLOB**2)
        along = (y / height - self._row).square() / (2 * _BLOB**2)
        return (-along).exp().unsqueeze(-1) * (-across).exp().unsqueeze(-2)


def _convolution(x: Tensor, layer: nn.Module) -> Tensor:
    """Apply a convolution with a stride of 1."""
    assert isinstance(layer, nn.Conv2d)
    return F.conv2d(x, layer.weight, layer.bias, padding=layer.padding)
