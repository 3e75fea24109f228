"""Content of the figure of groups, from training episodes written by hand."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex

from bgpo_trl.figures.groups import plot_groups
from bgpo_trl.runs.results import Run

TASKS = ["grasp_glass", "push_green_to_white"]
CONFIG = {"seeds": [3, 8], "tasks": TASKS, "task_starts": [0, 3], "episodes": 8}
BLUE, ORANGE = "#0072b2", "#d55e00"
# Task, group and groups known afterwards, of seeds 3 and 8: task 2 is first played by group 0.
FIRST = [(0, 0, 1), (0, 0, 1), (0, 0, 1), (1, 0, 2), (1, 1, 2), (0, 0, 2), (1, 1, 2), (0, 0, 2)]
SECOND = [(0, 0, 1), (0, 0, 1), (0, 0, 1), (1, 0, 1), (1, 0, 1), (0, 0, 1), (1, 0, 3), (0, 2, 3)]


@pytest.fixture
def run():
    """Seeds 8 and 3 with rows in reverse order; seed 8 has played one episode more."""
    rows = [
        (seed, episode, TASKS[task], group, num_groups, 2 * episode + seed)
        for seed, played in ((8, [*SECOND, (1, 0, 3)]), (3, FIRST))
        for episode, (task, group, num_groups) in enumerate(played, 1)
    ]
    columns = ["seed", "episode", "task", "group", "num_groups", "num_nodes"]
    training = pd.DataFrame(rows[::-1], columns=columns)
    return Run((Path("x"),), CONFIG, {}, tests=pd.DataFrame({"episode": [4, 9]}), training=training)


def marks(axes):
    """Return row, color and episode of the marks, in the order in which they are drawn."""
    found = []
    for lines in axes.collections:
        assert isinstance(lines, LineCollection)
        for segment in lines.get_segments():
            (episode, low), (same, high) = np.round(segment, 6)
            assert episode == same and high - low == pytest.approx(0.8)
            found.append((round((low + high) / 2), to_hex(lines.get_color()[0]), int(episode)))
    return found


def test_a_group_has_a_row_with_a_mark_for_each_episode(run):
    training = run.training[run.training["episode"] < 9]
    numbers, first, second = plot_groups(replace(run, training=training)).axes
    start, of_second, of_first = numbers.lines
    assert set(start.get_xdata()) == {3}
    assert of_first.get_ydata().tolist() == [1, 1, 1, 2, 2, 2, 2, 2]
    assert of_second.get_ydata().tolist() == [1, 1, 1, 1, 1, 1, 3, 3]
    # The one episode of task 2 is drawn over those of task 1.
    row = [(0, BLUE, episode) for episode in (1, 2, 3, 6, 8)] + [(0, ORANGE, 4)]
    assert marks(first) == [*row, (1, ORANGE, 5), (1, ORANGE, 7)]
    row = [(0, BLUE, episode) for episode in (1, 2, 3, 6)]
    assert marks(second) == [*row, *((0, ORANGE, e) for e in (4, 5, 7)), (1, BLUE, 8)]
    # Purity: group 0 played one episode of task 2; three of group 0 are not of task 1.
    assert first.get_title(loc="left") == "seed 3: 2 groups, 87.5 % pure"
    assert second.get_title(loc="left") == "seed 8: 3 groups, 62.5 % pure"
    # Rows are shaded from the first to the last episode of their group, whose number they have.
    assert [(bar.get_x(), bar.get_width()) for bar in first.patches] == [(1, 7), (5, 2)]
    assert [(bar.get_x(), bar.get_width()) for bar in second.patches] == [(1, 6), (8, 0)]
    assert [text.get_text() for text in second.get_yticklabels()] == ["0", "2"]


def test_runs_without_training_episodes_are_refused(run):
    for training in (None, run.training[:0]):
        empty = replace(run, training=training)
        with pytest.raises(ValueError, match="no training episode to show"):
            plot_groups(empty)
