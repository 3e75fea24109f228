"""Content of the figures of GWR-B's nodes."""

import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from scipy.spatial.distance import pdist

from bgpo_trl.figures.gwr import plot_gwr_pca

TASKS = ["grasp_glass", "push_green_to_white"]


def test_components_keep_distances_within_a_plane():
    generator = np.random.default_rng(0)
    plane = np.linalg.qr(generator.normal(size=(32, 2)))[0].T
    weights = generator.normal(size=(40, 2)) @ plane + generator.normal(size=32)
    figure = plot_gwr_pca(torch.from_numpy(weights), torch.zeros(40, dtype=torch.long), ["a"])
    (axes,) = figure.axes
    points = np.asarray(axes.collections[0].get_offsets())
    np.testing.assert_allclose(pdist(points), pdist(weights))
    assert points.var(axis=0)[0] > points.var(axis=0)[1]
    np.testing.assert_allclose(points.mean(axis=0), 0, atol=1e-9)
    np.testing.assert_allclose(np.cov(points.T)[0, 1], 0, atol=1e-9)


def test_axes_are_labeled_with_the_share_of_variance():
    # Variances 9 and 1 along two axes of three.
    weights = np.array([[3, 0, 5], [-3, 0, 5], [0, 1, 5], [0, -1, 5]])
    (axes,) = plot_gwr_pca(weights, np.zeros(4, dtype=int), ["a"]).axes
    assert axes.get_xlabel() == "Principal component 1 (90% of variance)"
    assert axes.get_ylabel() == "Principal component 2 (10% of variance)"


def test_nodes_are_colored_by_task_and_in_a_second_panel_by_group():
    weights = np.array([[3.0, 0], [-3, 0], [0, 1], [0, -1], [0, 0]])
    figure = plot_gwr_pca(weights, [1, 0, 1, -1, 0], TASKS, torch.tensor([2, 0, 2, 0, 0]))
    assert [
        {
            kind.get_label(): np.asarray(kind.get_offsets()).round(9).tolist()
            for kind in a.collections
        }
        for a in figure.axes
    ] == [
        {
            "task 1: grasp glass (2)": [[-3, 0], [0, 0]],
            "task 2: push green to white (2)": [[3, 0], [0, 1]],
            "no demonstration (1)": [[0, -1]],
        },
        {"group 0 (3)": [[-3, 0], [0, -1], [0, 0]], "group 2 (2)": [[3, 0], [0, 1]]},
    ]
    colors = [to_hex(kind.get_facecolor()[0]) for a in figure.axes for kind in a.collections]
    assert len(set(colors)) == 5  # groups are no tasks
    FigureCanvasAgg(figure).draw()
    by_task, by_group = figure.axes
    assert by_task.get_position().height == pytest.approx(by_group.get_position().height)
    assert by_task.get_xlim() == by_group.get_xlim()
