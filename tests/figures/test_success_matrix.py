"""Content of the heat maps of success after each phase."""

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from bgpo_trl.figures.success_matrix import plot_success_matrices
from suites import nico
from tests.figures.test_curves import check_labels, visible_texts

NAN = np.nan
FIRST, SECOND = [[0.75, NAN], [0.5, 1.0]], [[0.25, NAN], [0.0, 0.125]]


def heat_maps(figure):
    """Returns the panels without the color bar."""
    return [axes for axes in figure.axes if axes.images]


def test_a_panel_shows_the_matrix_as_colors_and_numbers():
    figure = plot_success_matrices({"one": FIRST, "two": SECOND}, ["grasp_glass", "lift_green"])
    one, two = heat_maps(figure)
    assert (one.get_title(), two.get_title()) == ("one", "two")
    for panel, matrix in ((one, FIRST), (two, SECOND)):
        np.testing.assert_array_equal(np.ma.filled(panel.images[0].get_array(), NAN), matrix)
        assert panel.images[0].get_clim() == (0, 1)
    numbers = {text.get_position(): text.get_text() for text in one.texts}
    assert numbers == {(0, 0): "75", (0, 1): "50", (1, 1): "100"}  # column and row, from the top
    rows = [label.get_text() for label in one.get_yticklabels()]
    assert rows == ["1: grasp glass", "2: lift green"]
    assert [label.get_text() for label in two.get_yticklabels()] == ["1", "2"]


def test_matrices_of_other_tasks_are_refused():
    with pytest.raises(ValueError, match=r"must be \[3, 3\], a row and a column per task, not \[2"):
        plot_success_matrices({"one": FIRST}, ["a", "b", "c"])
    with pytest.raises(ValueError, match="not none"):
        plot_success_matrices({}, ["a", "b"])


@pytest.mark.parametrize("n_panels", [1, 5])
def test_no_label_of_eight_tasks_overlaps_another(n_panels):
    matrix = np.where(np.tri(8) == 1, np.linspace(0, 1, 64).reshape(8, 8), NAN)
    panels = {f"Dist-NLL + demonstrations {number}": matrix for number in range(n_panels)}
    figure = plot_success_matrices(panels, nico.ALL_TASKS)
    FigureCanvasAgg(figure).draw()
    assert len(visible_texts(figure)) > 36 * n_panels
    check_labels(figure)
