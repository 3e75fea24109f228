import itertools

import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex

from bgpo_trl.figures.gwr import plot_gwr_pca

TASKS = ["grasp_glass", "push_green_to_glass", "push_green_to_white"]


def test_pca_keeps_the_distances_of_what_lies_in_a_plane():
    generator = np.random.default_rng(0)
    plane = np.linalg.qr(generator.normal(size=(32, 2)))[0].T
    weights = generator.normal(size=(40, 2)) @ plane + generator.normal(size=32)
    figure = plot_gwr_pca(torch.from_numpy(weights), torch.zeros(40, dtype=torch.long), ["a"])
    (axes,) = figure.axes
    points = np.asarray(axes.collections[0].get_offsets())
    for i, j in itertools.combinations(range(40), 2):
        assert np.linalg.norm(points[i] - points[j]) == pytest.approx(
            np.linalg.norm(weights[i] - weights[j])
        )
    assert points.var(axis=0)[0] > points.var(axis=0)[1]
    np.testing.assert_allclose(points.mean(axis=0), 0, atol=1e-9)
    np.testing.assert_allclose(np.cov(points.T)[0, 1], 0, atol=1e-9)


def test_pca_tells_the_share_of_variance():
    # Variances 9 and 1 along two axes of three.
    weights = np.array([[3, 0, 5], [-3, 0, 5], [0, 1, 5], [0, -1, 5]])
    (axes,) = plot_gwr_pca(weights, np.zeros(4, dtype=int), ["a"]).axes
    assert axes.get_xlabel() == "Principal component 1 (90% of variance)"
    assert axes.get_ylabel() == "Principal component 2 (10% of variance)"
    np.testing.assert_allclose(
        np.asarray(axes.collections[0].get_offsets()), weights[:, :2], atol=1e-12
    )


def test_pca_colors_nodes_by_task():
    weights = np.array([[3.0, 0], [-3, 0], [0, 1], [0, -1], [0, 0]])
    (axes,) = plot_gwr_pca(weights, [1, 0, 1, -1, 0], TASKS[:2]).axes
    nodes = {
        group.get_label(): np.asarray(group.get_offsets()).round(9).tolist()
        for group in axes.collections
    }
    assert nodes == {
        "task 1: grasp glass (2)": [[-3, 0], [0, 0]],
        "task 2: push green to glass (2)": [[3, 0], [0, 1]],
        "no demonstration (1)": [[0, -1]],
    }
    assert len({to_hex(group.get_facecolor()[0]) for group in axes.collections}) == 3


def test_pca_by_group_stands_beside_the_one_by_task():
    weights = np.array([[3.0, 0], [-3, 0], [0, 1], [0, -1], [0, 0]])
    figure = plot_gwr_pca(weights, [1, 0, 1, -1, 0], TASKS[:2], torch.tensor([2, 0, 2, 0, 0]))
    by_task, by_group = figure.axes
    nodes = {
        group.get_label(): np.asarray(group.get_offsets()).round(9).tolist()
        for group in by_group.collections
    }
    assert nodes == {
        "group 0 (3)": [[-3, 0], [0, -1], [0, 0]],
        "group 2 (2)": [[3, 0], [0, 1]],
    }
    colors = [to_hex(c.get_facecolor()[0]) for a in figure.axes for c in a.collections]
    assert len(set(colors)) == 5  # groups are no tasks
    legends = [[text.get_text() for text in a.get_legend().get_texts()] for a in figure.axes]
    assert legends == [[c.get_label() for c in a.collections] for a in figure.axes]
    FigureCanvasAgg(figure).draw()
    heights = [axes.get_position().bounds[1::2] for axes in (by_task, by_group)]
    assert heights[0] == pytest.approx(heights[1])
    assert by_task.get_xlim() == by_group.get_xlim()


def test_pca_of_equal_nodes_is_a_point():
    (axes,) = plot_gwr_pca(np.ones((3, 4)), [0, 0, 0], ["a"]).axes
    np.testing.assert_array_equal(np.asarray(axes.collections[0].get_offsets()), np.zeros((3, 2)))


@pytest.mark.parametrize(
    ("weights", "node_task", "message"),
    [
        (np.zeros((1, 4)), [0], r"N, d >= 2, not \[1, 4\]"),
        (np.zeros(4), [0] * 4, "N, d >= 2"),
        (np.full((3, 4), np.nan), [0] * 3, "must be finite"),
        (np.zeros((3, 4)), [0] * 2, "one task for each of the 3 nodes"),
        (np.zeros((3, 4)), [0, 1, 2], "position in the 2 task_names, not 0 to 2"),
        (np.zeros((3, 4)), [0, 1, -2], "not -2 to 1"),
    ],
)
def test_bad_pca_input_is_refused(weights, node_task, message):
    with pytest.raises(ValueError, match=message):
        plot_gwr_pca(weights, node_task, ["a", "b"])


def test_groups_of_other_nodes_are_refused():
    with pytest.raises(ValueError, match="one group for each of the 3 nodes, not the shape"):
        plot_gwr_pca(np.zeros((3, 4)), [0, 0, 1], ["a", "b"], [0, 1])
