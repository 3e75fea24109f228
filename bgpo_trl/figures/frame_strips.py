"""Figure of episodes as rows of frames."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray


def plot_frame_strips(episodes: Mapping[str, NDArray], n_frames: int = 8) -> Figure:
    """Plot episodes, frames uint8 ``[N, 32, 64, 3]`` by title, as rows of frames.

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
        label.set(fontsize=7, in_layout=False)  # A long title must not widen its column.
    return figure
