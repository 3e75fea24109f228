"""Videos of what the robot sees."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image


def save_gif(
    frames: NDArray[np.uint8], path: str | os.PathLike[str], *, fps: float = 5.0, scale: int = 4
) -> None:
    """Saves frames as an animated GIF that plays over and over.

    Args:
        frames: uint8 ``[T, H, W, 3]``.
        path: Where to, ending in ``.gif``; its folder is made if it does not exist.
        fps: Frames a second; by default as fast as the robot acts, a step every 0.2 s.
        scale: Size of a frame's pixel in pixels of the GIF.

    Raises:
        ValueError: If the frames have another shape or type, or there are none.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "dark.gif"
        >>> save_gif(np.zeros((2, 32, 64, 3), np.uint8), path)
        >>> Image.open(path).size
        (256, 128)
    """
    if frames.dtype != np.uint8 or frames.ndim != 4 or frames.shape[-1] != 3 or not len(frames):
        raise ValueError(
            f"frames must be uint8 [T, H, W, 3] with T at least 1, got {frames.dtype} "
            f"{list(frames.shape)}"
        )
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    large = frames.repeat(scale, 1).repeat(scale, 2)
    first, *others = (Image.fromarray(frame) for frame in large)
    first.save(path, save_all=True, append_images=others, duration=round(1000 / fps), loop=0)
