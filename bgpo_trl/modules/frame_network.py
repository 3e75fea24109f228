"""Frame networks: from a camera frame to the vector that policies observe, the VAE or one's own."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

# On a CPU, activations of more frames do not fit into the cache, and take twice as long.
_FRAMES_AT_ONCE = 64


class FrameNetwork(nn.Module):
    """Base of the networks that encode frames, one at a time and without gradient.

    A subclass sets `identity` and defines `features`. All that these depend on, beside the size of
    the frames, has to be in parameters and buffers: files hold nothing else.

    Args:
        latent_size: Numbers in a vector.
        frame_shape: Height and width of a frame, at least 16 each.

    Raises:
        ValueError: If a vector has no numbers, or frames are too small; from methods, if frames
            have another dtype or shape, or `features` returns another shape.

    Attributes:
        identity: Name, a space, and version. Of a network of one's own, the name is that in
            `FRAME_NETWORKS`; change the version if the same weights give other features.
        latent_mean: Buffer ``[latent_size]``, subtracted from the features by `latent`.
        latent_std: Buffer ``[latent_size]``, by which `latent` divides.

    Examples:
        >>> class MeanColor(FrameNetwork):
        ...     identity = "mean-color 1"
        ...
        ...     def features(self, frames):
        ...         return frames.float().mean((1, 2)) / 255
        >>> frames = torch.zeros(10, 32, 64, 3, dtype=torch.uint8)
        >>> MeanColor(3, (32, 64)).latent(frames).shape
        torch.Size([10, 3])
    """

    identity: str
    latent_mean: Tensor
    latent_std: Tensor

    def __init__(self, latent_size: int, frame_shape: Sequence[int]) -> None:
        if latent_size < 1:
            raise ValueError(f"latent_size must be at least 1, got {latent_size}")
        if len(frame_shape) != 2 or min(frame_shape) < 16:
            raise ValueError(f"frames must be at least 16 x 16 pixels, got {tuple(frame_shape)}")
        super().__init__()
        self.latent_size = latent_size
        self.frame_shape = (int(frame_shape[0]), int(frame_shape[1]))
        self.register_buffer("latent_mean", torch.zeros(latent_size))
        self.register_buffer("latent_std", torch.ones(latent_size))

    def features(self, frames: Tensor) -> Tensor:
        """Return the vectors of frames uint8 ``[N, H, W, 3]``, at any scale, ``[N, latent_size]``.

        The vector of a frame must not depend on the others.
        """
        raise NotImplementedError(f"{type(self).__name__} does not define features()")

    @torch.no_grad()
    def latent(self, pixels: Tensor) -> Tensor:
        """Return the vectors used downstream: features, standardized, ``[..., latent_size]``.

        Args:
            pixels: Frames, uint8 ``[..., H, W, 3]``.
        """
        self.check_frames(pixels)
        frames = pixels.reshape(-1, *pixels.shape[-3:])
        if frames.device.type == "cpu" and len(frames) > _FRAMES_AT_ONCE:
            made = torch.cat([self.features(part) for part in frames.split(_FRAMES_AT_ONCE)])
        else:
            made = self.features(frames)
        if made.shape != (len(frames), self.latent_size):
            raise ValueError(
                f"{type(self).__name__}.features() must return [{len(frames)}, {self.latent_size}] "
                f"for {len(frames)} frames, got {[*made.shape]}"
            )
        standardized = (made - self.latent_mean) / self.latent_std
        return standardized.reshape(*pixels.shape[:-3], self.latent_size)

    @torch.no_grad()
    def set_latent_scale(self, features: Tensor, floor: float = 0.1) -> None:
        """Set mean and deviation of `latent` from the features ``[N, latent_size]`` of frames.

        Some dimensions hardly change: the KL term of the VAE switches them off, for instance.
        Dividing by their tiny spread would turn them into noise as large as the signal. No divisor
        is below ``floor`` times the largest.

        Raises:
            ValueError: If they have another shape, fewer than two rows, or are constant or not
                finite.
        """
        shape = [*features.shape]
        if shape[1:] != [self.latent_size] or shape[0] < 2:
            raise ValueError(f"features must be [N, {self.latent_size}], N >= 2, got {shape}")
        std, mean = torch.std_mean(features, 0)
        if not (std.isfinite().all() and std.max() > 0):
            raise ValueError(
                "the features of frames are constant or not finite: train the frame network "
                "(again), or take another one"
            )
        self.latent_mean.copy_(mean)
        self.latent_std.copy_(std.clamp_min(floor * std.max()))

    def check_frames(self, pixels: Tensor) -> None:
        """Raise ``ValueError`` unless frames are uint8 ``[..., H, W, 3]``."""
        height, width = self.frame_shape
        if pixels.dtype != torch.uint8 or pixels.shape[-3:] != (height, width, 3):
            raise ValueError(
                f"pixels must be uint8 [..., {height}, {width}, 3], got {pixels.dtype} "
                f"{tuple(pixels.shape)}"
            )


FRAME_NETWORKS: dict[str, Callable[[tuple[int, int]], FrameNetwork]] = {}
"""Frame networks of one's own by name: functions from the height and width of a frame to a network,
which is not trained further. A module of ``--import`` adds them; the VAE is not among them."""


class FrameNetworkError(ValueError):
    """A frame network cannot be made, since the module that adds it is missing or has changed."""


def make_frame_network(name: str, frame_shape: Sequence[int]) -> FrameNetwork:
    """Return a new frame network of `FRAME_NETWORKS`, in eval mode, without gradients.

    Raises:
        FrameNetworkError: If there is none of this name, or it is not what its entry says.
    """
    if name not in FRAME_NETWORKS:
        known = ", ".join(["vae", *FRAME_NETWORKS])
        raise FrameNetworkError(
            f"there is no frame network {name!r}, only {known}: name the module that adds it with "
            "--import, or import it first in Python"
        )
    height, width = frame_shape
    made = FRAME_NETWORKS[name]((int(height), int(width)))
    if not isinstance(made, FrameNetwork):
        raise FrameNetworkError(
            f"FRAME_NETWORKS[{name!r}] made a {type(made).__name__}: derive it from FrameNetwork"
        )
    words = getattr(made, "identity", "").split(" ")
    if len(words) != 2 or words[0] != name or not words[1]:
        raise FrameNetworkError(
            f"the identity of {type(made).__name__} is its name in FRAME_NETWORKS, a space and a "
            f"version, such as '{name} 1', got {' '.join(words)!r}"
        )
    if made.frame_shape != (height, width):
        raise FrameNetworkError(
            f"the frame network {name!r} is of frames {[*made.frame_shape]}, these are "
            f"{[height, width]}: make it of the shape that its entry is called with"
        )
    return made.eval().requires_grad_(False)
