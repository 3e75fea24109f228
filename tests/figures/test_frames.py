"""Frames of episodes as strips and as GIFs."""

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from bgpo_trl.analysis.tables import markdown
from bgpo_trl.figures.frames import plot_frame_strips, save_gif
from bgpo_trl.figures.style import readable, save_figure


def test_strips_show_evenly_spaced_frames():
    short = np.arange(3, dtype=np.uint8)[:, None, None, None].repeat(3, -1) * 9
    long = np.arange(40, dtype=np.uint8)[:, None, None, None].repeat(3, -1)
    figure = plot_frame_strips({"short": short, "long " * 20: long}, n_frames=4)
    shown = [[int(np.asarray(i.get_array())[0, 0, 0]) for i in a.images] for a in figure.axes]
    assert shown == [[0], [9], [18], [], [0], [13], [26], [39]]
    assert [a.get_title() for a in figure.axes[4:]] == ["step 0", "step 13", "step 26", "step 39"]
    FigureCanvasAgg(figure).draw()
    gaps = np.diff([axes.get_position().x0 for axes in figure.axes[4:]])
    assert np.allclose(gaps, gaps[0])  # However long a title is.


def test_a_gif_keeps_frames_and_duration_and_enlarges_them(tmp_path):
    frames = np.zeros((4, 2, 3, 3), np.uint8)
    for index, color in enumerate([(255, 0, 0), (0, 255, 0), (0, 0, 255), (90, 90, 90)]):
        frames[index] = color
        frames[index, 0, 1] = 255
    save_gif(frames, tmp_path / "videos" / "colors.gif", fps=4.0, scale=2)
    with Image.open(tmp_path / "videos" / "colors.gif") as video:
        assert video.n_frames == 4
        assert video.info["loop"] == 0
        for index, frame in enumerate(frames):
            video.seek(index)
            assert video.info["duration"] == 250
            shown = np.asarray(video.convert("RGB"))
            assert shown.shape == (4, 6, 3)
            for row, column in np.ndindex(4, 6):
                assert (shown[row, column] == frame[row // 2, column // 2]).all()


def test_names_of_tasks_are_no_formulas(tmp_path):
    name = r"use $\frac$ | pay $5 or $6"
    figure = plot_frame_strips({name: np.zeros((3, 4, 6, 3), np.uint8)})
    label = figure.text(0.0, 0.0, readable(name))
    assert label.get_window_extent(FigureCanvasAgg(figure).get_renderer()).width > 0
    save_figure(figure, tmp_path / "names.png", dpi=50)
    assert markdown([["task"], [name]]).endswith(r"| use $\frac$ \| pay $5 or $6 |")
