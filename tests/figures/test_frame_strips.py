import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from bgpo_trl.figures.frames import plot_frame_strips


def test_frame_strips_go_from_the_first_to_the_last_frame():
    short = np.arange(3, dtype=np.uint8)[:, None, None, None].repeat(3, -1) * 9
    long = np.arange(40, dtype=np.uint8)[:, None, None, None].repeat(3, -1)
    figure = plot_frame_strips({"short": short, "long " * 20: long}, n_frames=4)
    shown = [[int(np.asarray(i.get_array())[0, 0, 0]) for i in a.images] for a in figure.axes]
    assert shown == [[0], [9], [18], [], [0], [13], [26], [39]]
    assert [a.get_title() for a in figure.axes[4:]] == ["step 0", "step 13", "step 26", "step 39"]
    assert [a.texts[0].get_text() for a in figure.axes[::4]] == [
        "short",
        "long " * 20,
    ]
    FigureCanvasAgg(figure).draw()
    gaps = np.diff([axes.get_position().x0 for axes in figure.axes[4:]])
    assert np.allclose(gaps, gaps[0])  # However long a title is.


@pytest.mark.parametrize("episodes", [{}, {"none": np.zeros((0, 2, 2, 3), np.uint8)}])
def test_nothing_to_show_is_refused(episodes):
    with pytest.raises(ValueError, match="nothing to show"):
        plot_frame_strips(episodes)
