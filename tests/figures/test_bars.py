"""Content of the figure of success by task and condition."""

import numpy as np
import pytest

from bgpo_trl.figures.bars import plot_success_bars

SUCCESS = {"seen": [[0.5, 1.0], [0.7, 1.0], [0.6, 1.0]], "hidden": [[0.0, 0.2]]}


def test_bars_are_means_with_their_intervals():
    figure = plot_success_bars(SUCCESS, ["grasp_glass", "push_green_to_white"])
    (axes,) = figure.axes
    heights = [bar.get_height() for bar in axes.patches]
    assert heights == pytest.approx([0.6, 1.0, 0.0, 0.2])
    centers = [bar.get_x() + bar.get_width() / 2 for bar in axes.patches]
    assert centers == pytest.approx([-0.2, 0.8, 0.2, 1.2])
    # The t value for three seeds is 4.303; one seed has no interval and no dots.
    intervals, dots = axes.collections
    found = np.array([segment[:, 1] for segment in intervals.get_segments()])
    half = 4.303 * 0.1 / np.sqrt(3)
    assert found == pytest.approx(np.array([[0.6 - half, 0.6 + half], [1, 1]]), abs=1e-3)
    assert sorted(dots.get_offsets()[:, 1]) == pytest.approx([0.5, 0.6, 0.7, 1, 1, 1])
    names = [label.get_text() for label in axes.get_xticklabels()]
    assert names == ["grasp glass", "push green\nto white"]
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["seen", "hidden"]


@pytest.mark.parametrize("success", [{}, {"seen": [[0.5]]}, {"seen": [0.5, 1.0]}])
def test_other_shapes_are_refused(success):
    with pytest.raises(ValueError, match=r"success must be \[seeds, 2\] by condition"):
        plot_success_bars(success, ["a", "b"])
