"""Content of the figure of GWR-B's growth; not its looks."""

import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg

from bgpo_trl.figures.gwr import plot_gwr_growth

TASKS = ["grasp_glass", "push_green_to_white"]
# In a plane of four dimensions: the last graph's spread is largest along the second axis.
LAST = np.array([[0, 0, 0, 0], [0, 4, 0, 0], [1, 0, 0, 0], [1, 4, 0, 0], [0.5, 90, 0, 0]])
GRAPHS = {
    20: (LAST, [[0, 1], [2, 3], [0, 4]], [0, 1, 0, 1, -1]),
    10: (LAST[:2] + np.array([0.5, 1, 0, 0]), [[0, 1]], [0, -1]),
}


def places(axes):
    """Returns the nodes drawn, those of one kind after those of another."""
    return np.concatenate([np.asarray(c.get_offsets()) for c in axes.collections[1:]])


def test_all_panels_have_the_components_of_the_last_graph():
    early, late, _ = plot_gwr_growth(GRAPHS, [[1, 2]], TASKS).axes
    # Of the four that match, the mean is (0.5, 2); components are the second and the first axis.
    expected = {"late": [(-2, -0.5), (-2, 0.5), (2, -0.5), (2, 0.5), (88, 0)]}
    expected["early"] = [(-1, 0), (3, 0)]
    assert places(late) == pytest.approx(np.array(expected["late"]))
    assert places(early) == pytest.approx(np.array(expected["early"]))
    assert (early.get_xlim(), early.get_ylim()) == (late.get_xlim(), late.get_ylim())
    assert late.get_xlabel() == "component 1 (94% of variance)"  # 16 of 17
    assert early.get_title() == "episode 10: 2 nodes, 1 outside"
    assert late.get_title() == "episode 20: 5 nodes, 1 outside"


def test_nodes_have_the_colors_of_their_tasks_and_edges_join_them():
    figure = plot_gwr_growth(GRAPHS, [[1, 2]], TASKS)
    early, late, _ = figure.axes
    assert [len(c.get_offsets()) for c in early.collections[1:]] == [1, 0, 1]
    assert [len(c.get_offsets()) for c in late.collections[1:]] == [2, 2, 1]
    colors = [tuple(c.get_facecolor()[0]) for c in late.collections[1:]]
    assert len(set(colors)) == 3
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["task 1: grasp glass", "task 2: push green to white", "no demonstration"]
    edges = [segment.tolist() for segment in late.collections[0].get_segments()]
    ends = [[(-2, -0.5), (2, -0.5)], [(-2, 0.5), (2, 0.5)], [(-2, -0.5), (88, 0)]]
    assert np.array(edges) == pytest.approx(np.array(ends))


def test_the_number_of_nodes_is_drawn_for_each_seed_the_first_above():
    counts = plot_gwr_growth(GRAPHS, [[2, 3, 5], [2, 2, 2]], TASKS).axes[-1]
    other, first, moments = [np.array(line.get_data()).T.tolist() for line in counts.lines]
    assert first == [[1, 2], [2, 3], [3, 5]]
    assert other == [[1, 2], [2, 2], [3, 2]]
    assert moments == [[10, 2], [20, 5]]


def test_tensors_and_graphs_hardly_begun_can_be_drawn():
    start = (torch.rand(2, 32), torch.tensor([[0, 1]]), torch.tensor([-1, -1]))
    no_edge = (torch.rand(2, 32), torch.zeros(0, 2, dtype=torch.int64), torch.tensor([0, -1]))
    for graph in (start, no_edge):
        FigureCanvasAgg(plot_gwr_growth({1: graph}, [[2]], TASKS)).draw()


def test_without_a_graph_there_is_nothing_to_show():
    with pytest.raises(ValueError, match="no graph to show: let the run save some first"):
        plot_gwr_growth({}, [], TASKS)
