"""Videos of frames."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image


def save_gif(
    frames: NDArray[np.uint8], path: str | os.PathLike[str], *, fps: float = 5.0, scale: int = 4
) -> None:
    """Save frames uint8 ``[T, H, W, 3]`` as an endlessly looping GIF.

    Args:
        frames: The frames, at least one.
        path: File ending in ``.gif``; its folder is made if missing.
        fps: Frames per second; the default is the robot's speed, a step every 0.2 s.
        scale: Pixels of the GIF per pixel of a frame, along each axis.

    Raises:
        ValueError: If the frames have another shape or dtype, or there are none.
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
