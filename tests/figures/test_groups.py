"""Content of the figure of groups, from a train.csv written by hand; not its looks."""

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex

from bgpo_trl.figures.groups import plot_groups, read_groups

TASKS = ["grasp_glass", "push_green_to_white"]
PRESENTED = {"grasp_glass": 0, "push_green_to_white": 3}
BLUE, ORANGE = "#0072b2", "#d55e00"
# Task, group and groups known afterwards, of seeds 3 and 8: task 2 is first played by group 0.
FIRST = [(0, 0, 1), (0, 0, 1), (0, 0, 1), (1, 0, 2), (1, 1, 2), (0, 0, 2), (1, 1, 2), (0, 0, 2)]
SECOND = [(0, 0, 1), (0, 0, 1), (0, 0, 1), (1, 0, 1), (1, 0, 1), (0, 0, 1), (1, 0, 3), (0, 2, 3)]


@pytest.fixture
def path(tmp_path):
    rows = [
        f"{seed},{episode},{TASKS[task]},{group},{num_groups}"
        for seed, run in ((8, SECOND), (3, FIRST))
        for episode, (task, group, num_groups) in enumerate(run, 1)
    ]
    path = tmp_path / "train.csv"
    path.write_text("seed,episode,task,group,num_groups\n" + "\n".join(rows[::-1]) + "\n")
    return path


def marks(axes):
    """Returns row, colors and episodes of the marks, in the order in which they are drawn."""
    found = []
    for lines in axes.collections:
        assert isinstance(lines, LineCollection)
        for segment in lines.get_segments():
            (episode, low), (same, high) = np.round(segment, 6)
            assert episode == same and high - low == pytest.approx(0.8)
            found.append((round((low + high) / 2), to_hex(lines.get_color()[0]), int(episode)))
    return found


def test_episodes_are_read_by_seed_and_in_order(path):
    seeds = read_groups(path, TASKS)
    assert list(seeds) == [3, 8]
    assert seeds[8].episode.tolist() == list(range(1, 9))
    assert [*zip(seeds[3].task, seeds[3].group, seeds[3].num_groups, strict=True)] == FIRST
    assert seeds[3].purity == 7 / 8  # group 0 played one episode of task 2
    assert seeds[8].purity == 5 / 8  # four of group 0 are of task 1, and the one of group 2


def test_the_number_of_groups_is_drawn_for_each_seed_the_first_above(path):
    counts = plot_groups(read_groups(path, TASKS), PRESENTED).axes[0]
    start, other, first = [np.array(line.get_data()).T.tolist() for line in counts.lines]
    assert {x for x, _ in start} == {3}
    assert [text.get_text() for text in counts.texts] == ["task 2"]
    assert [y for _, y in first] == [1, 1, 1, 2, 2, 2, 2, 2]
    assert [y for _, y in other] == [1, 1, 1, 1, 1, 1, 3, 3]


def test_a_group_has_a_row_with_a_mark_for_each_episode(path):
    figure = plot_groups(read_groups(path, TASKS), PRESENTED)
    _, first, second = figure.axes
    # The one episode of task 2 is drawn over those of task 1.
    row = [(0, BLUE, episode) for episode in (1, 2, 3, 6, 8)] + [(0, ORANGE, 4)]
    assert marks(first) == [*row, (1, ORANGE, 5), (1, ORANGE, 7)]
    row = [(0, BLUE, episode) for episode in (1, 2, 3, 6)]
    assert marks(second) == [*row, *((0, ORANGE, e) for e in (4, 5, 7)), (1, BLUE, 8)]
    assert first.get_title(loc="left") == "seed 3: 2 groups, 87.5 % pure"
    assert second.get_title(loc="left") == "seed 8: 3 groups, 62.5 % pure"
    # Rows are shaded from the first to the last episode of their group, whose number they have.
    assert [(bar.get_x(), bar.get_width()) for bar in first.patches] == [(1, 7), (5, 2)]
    assert [(bar.get_x(), bar.get_width()) for bar in second.patches] == [(1, 6), (8, 0)]
    assert [text.get_text() for text in second.get_yticklabels()] == ["0", "2"]
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["task 1: grasp glass", "task 2: push green to white"]


def test_many_groups_of_many_seeds_fit_on_a_page(path):
    run = read_groups(path, TASKS)[8]
    for n_seeds in (1, 10):
        figure = plot_groups(dict.fromkeys(range(n_seeds), run), PRESENTED)
        assert figure.get_figheight() < 14
        FigureCanvasAgg(figure).draw()


def test_what_tells_no_groups_is_refused(path, tmp_path):
    with pytest.raises(ValueError, match="no training episode to show"):
        plot_groups({}, PRESENTED)
    with pytest.raises(ValueError, match=r"line 3 is damaged"):
        read_groups(path, TASKS[:1])
    old = tmp_path / "old.csv"
    old.write_text("seed,episode,task\n0,1,grasp_glass\n")
    with pytest.raises(ValueError, match="lacks the columns group, num_groups"):
        read_groups(old, TASKS)
