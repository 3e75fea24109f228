"""Content of the figure of nodes and groups, from a train.csv written by hand."""

import numpy as np
import pytest

from bgpo_trl.figures.groups import plot_counts, read_counts

HEAD = "seed,episode,num_nodes,num_groups\n"
# Nodes and groups after each episode; seed 8 has played one episode more.
ROWS = {3: [(2, 1), (4, 1), (6, 2)], 8: [(2, 1), (2, 1), (4, 3), (9, 3)]}
PRESENTED = {"grasp_glass": 0, "lift_green": 2}


@pytest.fixture
def path(tmp_path):
    lines = [
        f"{seed},{episode},{nodes},{groups}"
        for seed in (8, 3)
        for episode, (nodes, groups) in enumerate(ROWS[seed], 1)
    ]
    path = tmp_path / "train.csv"
    path.write_text(HEAD + "\n".join(lines[::-1]) + "\n")
    return path


def test_counts_are_read_by_seed_and_episode(path):
    counts = read_counts(path)
    assert counts["num_nodes"].tolist() == [[2, 4, 6], [2, 2, 4]]
    assert counts["num_groups"].tolist() == [[1, 1, 2], [1, 1, 3]]
    assert read_counts(path, last=2)["num_groups"].tolist() == [[1, 1], [1, 1]]


def test_lines_are_means_shaded_from_the_lowest_to_the_highest(path):
    figure = plot_counts({"BGPO": read_counts(path)}, PRESENTED)
    nodes, groups = figure.axes
    assert nodes.lines[0].get_xdata().tolist() == [1, 2, 3]
    assert nodes.lines[0].get_ydata().tolist() == [2, 3, 5]
    assert groups.lines[0].get_ydata().tolist() == [1, 1, 2.5]
    edges = np.concatenate([part.vertices for part in nodes.collections[0].get_paths()])
    assert set(edges[edges[:, 0] == 3, 1]) == {4, 6}
    for panel in figure.axes:
        assert [text.get_text() for text in panel.texts] == ["task 2"]
        assert list(panel.lines[1].get_xdata()) == [2, 2]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["BGPO"]


def test_a_run_without_episodes_is_refused(tmp_path):
    empty = tmp_path / "train.csv"
    empty.write_text(HEAD)
    for runs in ({}, {"BGPO": read_counts(empty)}):
        with pytest.raises(ValueError, match="no training episode to show: let the run train"):
            plot_counts(runs, PRESENTED)
