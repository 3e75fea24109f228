"""Episodes as pictures: rows of frames, and GIFs."""

from __future__ import annotations

import io
import os
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from bgpo_trl.files.writing import make_folder, write_whole


def file_names(tasks: Sequence[str]) -> list[str]:
    """Return a name for a file of each task: its own, if no sign or length of it is a problem.

    Names that differ in case alone are one file on some disks; film.gif is that of `bgpo watch`.

    Examples:
        >>> file_names(["grasp_glass", "put a/b, then c", "put a/b: then c", "Left", "left"])
        ['grasp_glass', 'put_a_b_then_c.1', 'put_a_b_then_c.2', 'Left.3', 'left.4']
    """
    plain = [re.sub(r"[^\w-]+", "_", name)[:60] for name in tasks]
    taken = Counter(["film", *(name.lower() for name in tasks)])
    return [
        # A task's own name has no dot.
        name if name == short and taken[name.lower()] == 1 else f"{short}.{number}"
        for number, (name, short) in enumerate(zip(tasks, plain, strict=True))
    ]


def plot_frame_strips(episodes: Mapping[str, NDArray], n_frames: int = 8) -> Figure:
    """Plot episodes, frames uint8 ``[N, H, W, 3]`` by title, as rows of frames.

    A row has at most ``n_frames``, evenly spaced from the first to the last.

    Raises:
        ValueError: If there are no episodes, or one has no frames.
    """
    if not episodes or any(len(frames) == 0 for frames in episodes.values()):
        raise ValueError("there is nothing to show: give episodes of at least one frame.")
    figure = Figure(figsize=(1.3 * n_frames, 1.05 * len(episodes)))
    figure.set_layout_engine("constrained", h_pad=0.16)  # room for the titles of the rows
    panels = figure.subplots(len(episodes), n_frames, squeeze=False)
    for row, (title, frames) in zip(panels, episodes.items(), strict=True):
        shown = np.unique(np.linspace(0, len(frames) - 1, n_frames).round().astype(int))
        for panel in row:
            panel.set_axis_off()
        for panel, index in zip(row, shown, strict=False):
            panel.imshow(frames[index], interpolation="nearest")
            panel.set_title(f"step {index}", fontsize=6, pad=2)
        label = row[0].annotate(
            title, (0, 1), xytext=(0, 11), xycoords="axes fraction", textcoords="offset points"
        )
        # A long title must not widen its column; what is between dollars is no formula.
        label.set(fontsize=7, in_layout=False, parse_math=False)
    return figure


def save_gif(
    frames: NDArray[np.uint8], path: str | os.PathLike[str], *, fps: float = 5.0, scale: int = 4
) -> None:
    """Save frames uint8 ``[T, H, W, 3]`` as an endlessly looping GIF.

    Args:
        frames: The frames, at least one.
        path: File ending in ``.gif``; its folder is made if missing.
        fps: Frames per second; the default is NICO's speed, a step every 0.2 s.
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
    make_folder(path.parent)
    large = frames.repeat(scale, 1).repeat(scale, 2)
    first, *others = (Image.fromarray(frame) for frame in large)
    content = io.BytesIO()
    first.save(
        content,
        format="gif",
        save_all=True,
        append_images=others,
        duration=round(1000 / fps),
        loop=0,
    )
    write_whole(path, content.getvalue())
