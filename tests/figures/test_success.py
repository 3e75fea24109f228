"""Content of the figures of success, and labels of all figures."""

import itertools
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

from bgpo_trl.figures.frames import plot_frame_strips, save_gif
from bgpo_trl.figures.gwr import plot_gwr_pca
from bgpo_trl.figures.style import save_figure
from bgpo_trl.figures.success import plot_step_curves, plot_success_curves, plot_success_matrices
from bgpo_trl.runs.results import Run

TASKS = ["grasp_glass", "push_green_to_glass", "push_green_to_white"]


def run_of(rows: Iterable[tuple[int, ...]], tasks: Sequence[str], starts=None, **summary) -> Run:
    """Make a run from seed, episode, task, success and steps (30) of tests."""
    rows = [(*row, *[30][len(row) - 4 :]) for row in rows]
    tests = pd.DataFrame(rows, columns=["seed", "episode", "task", "success", "steps"])
    seeds = sorted(set(tests["seed"]))
    config = {"seeds": seeds, "tasks": [*tasks], "task_starts": [*(starts or (0,) * len(tasks))]}
    return Run((Path("x"),), config, summary, tests)


@pytest.fixture
def runs() -> dict[str, Run]:
    """Three algorithms, two seeds, tasks presented from episodes 0, 35 and 65 of 100."""
    starts, kinds = (0, 35, 65), itertools.product(range(2), range(1, 101), range(3))
    rows = [
        (seed, episode, TASKS[task], (seed + episode) % 2)
        for seed, episode, task in kinds
        if episode > starts[task]
    ]
    run = run_of(rows, TASKS, starts, random_success={TASKS[1]: 0.05})
    return dict.fromkeys(("BGPO", "MAML", "Dist-NLL"), run)


def curve(axes: Axes) -> dict[int, float]:
    """Returns the mean by episode, where there is one."""
    x, y = axes.lines[0].get_data()
    return {int(a): float(b) for a, b in zip(x, y, strict=True) if np.isfinite(b)}


def band(axes: Axes, episode: int) -> tuple[float, float]:
    """Returns the lower and upper edge of the shaded region."""
    vertices = np.concatenate([path.vertices for path in axes.collections[0].get_paths()])
    values = vertices[vertices[:, 0] == episode, 1]
    return float(values.min()), float(values.max())


def vertical_lines(axes: Axes) -> list[float]:
    lines = [np.asarray(line.get_xdata()) for line in axes.lines if line.get_linestyle() == "--"]
    return sorted(float(x[0]) for x in lines if len(x) == 2 and x[0] == x[1])


def test_mean_and_spread_over_seeds_by_hand():
    outcomes = enumerate([(1, 1, 0), (0, 1, 0)])
    rows = [(seed, e, "push", won) for seed, s in outcomes for e, won in enumerate(s, 1)]
    overall, push = plot_success_curves({"BGPO": run_of(rows, ["push"])}, window=2).axes
    # Seed 0: 1, (1 + 1) / 2, (1 + 0) / 2; seed 1: 0, (0 + 1) / 2, (1 + 0) / 2.
    assert curve(overall) == curve(push) == {1: 0.5, 2: 0.75, 3: 0.5}
    assert band(overall, 1) == (0, 1)
    assert band(overall, 2) == (0.5, 1)
    assert band(overall, 3) == (0.5, 0.5)


def test_each_panel_shows_its_task_with_a_trailing_window():
    rows = [(0, 1, "a", 1), (0, 2, "b", 0), (0, 3, "a", 0), (0, 6, "b", 1), (1, 6, "b", 0)]
    overall, a, b = plot_success_curves({"BGPO": run_of(rows, "ab")}, window=3).axes
    assert [axes.get_title() for axes in (a, b)] == ["Task 1: a", "Task 2: b"]
    # A point for each evaluation: nothing is known of episodes 4 and 5.
    assert curve(overall) == pytest.approx({1: 1, 2: 1 / 2, 3: 1 / 3, 6: 1 / 2})
    assert curve(a) == {1: 1, 2: 1, 3: 1 / 2}
    # At 6, the second seed has its first test episode: mean of 1 and 0.
    assert curve(b) == {2: 0, 3: 0, 6: 1 / 2}


def test_task_starts_and_random_success_are_marked(runs):
    figure = plot_success_curves(runs)
    assert [vertical_lines(axes) for axes in figure.axes] == [[35, 65], [], [35], [65]]
    assert figure.axes[2].get_title() == "Task 2: push green to glass"
    by_chance = [
        any(np.array_equal(line.get_ydata(), [0.05, 0.05]) for line in axes.lines)
        for axes in figure.axes
    ]
    assert by_chance == [False, False, True, False]
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["BGPO (2 seeds)", "MAML (2 seeds)", "Dist-NLL (2 seeds)", "random policy"]


def test_steps_are_means_over_successes():
    rows = [(0, 1, "a", 1, 20), (0, 2, "a", 0, 50), (0, 3, "a", 1, 10)]
    rows += [(1, 1, "a", 0, 50), (1, 3, "a", 1, 30), (1, 3, "b", 0, 50)]
    run = run_of(rows, "ab", demonstrated_steps={"a": 28.0})
    figure = plot_step_curves({"BGPO": run}, window=2)
    overall, a, b = figure.axes
    # Seed 0: 20, 20, 10 (the failure has no steps, and episode 1 is out of the window).
    assert curve(overall) == curve(a) == {1: 20, 2: 20, 3: (10 + 30) / 2}
    assert curve(b) == {}
    assert [len(axes.lines) for axes in (overall, a, b)] == [2, 2, 1]  # one is for the legend
    assert list(a.lines[1].get_ydata()) == [28, 28]
    assert figure.legends[0].get_texts()[1].get_text() == "demonstrations"
    for panel in figure.axes:
        assert panel.get_ylim() == pytest.approx((0, 33))


def test_the_same_data_gives_the_same_file_without_global_state(runs, tmp_path):
    before = dict(mpl.rcParams)
    for name in ("first", "second"):
        save_figure(plot_success_curves(runs), tmp_path / "figures" / name)
    first, second = ((tmp_path / "figures" / name).read_bytes() for name in ("first", "second"))
    assert first == second
    assert first.startswith(b"\x89PNG")
    assert dict(mpl.rcParams) == before
    assert plt.get_fignums() == []


def visible_texts(figure: Figure) -> list[Text]:
    hidden = {
        id(text)
        for axes in figure.axes
        for axis in (axes.xaxis, axes.yaxis)
        for tick in axis.get_major_ticks()
        for text in (tick.label1, tick.label2)
        # Matplotlib keeps spare ticks beyond the ends of an axis, and does not draw them.
        if not min(axis.get_view_interval()) <= tick.get_loc() <= max(axis.get_view_interval())
    }
    return [
        text
        for text in figure.findobj(Text)
        if text.get_visible() and text.get_text() and id(text) not in hidden
    ]


def check_labels(figure: Figure, least: int = 1) -> None:
    """Check that each of at least so many labels lies within the figure and overlaps no other."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    texts = visible_texts(figure)
    assert len(texts) >= least
    boxes = [text.get_window_extent(canvas.get_renderer()) for text in texts]
    for text, box in zip(texts, boxes, strict=True):
        assert figure.bbox.x0 <= box.x0 and box.x1 <= figure.bbox.x1, text
        assert figure.bbox.y0 <= box.y0 and box.y1 <= figure.bbox.y1, text
    for (i, one), (j, other) in itertools.combinations(enumerate(boxes), 2):
        assert not one.overlaps(other), (texts[i], texts[j])


@pytest.mark.parametrize(
    ("n_tasks", "algorithms"),
    [(1, ["bgpo"]), (3, ["bgpo"]), (8, ["GWR-B + intrinsic reward", "GWR-B", "no", "x"])],
)
def test_no_label_is_cut_off_or_overlaps_another(n_tasks, algorithms):
    tasks = [f"push_green_to_{number}" for number in range(n_tasks)]
    rows = [(0, episode, tasks[episode % n_tasks], episode % 2) for episode in range(0, 20001, 100)]
    starts = [20000 * index // n_tasks for index in range(n_tasks)]
    marked = {"random_success": {tasks[0]: 0.1}, "demonstrated_steps": {tasks[0]: 28.0}}
    check_labels(
        plot_success_curves(dict.fromkeys(algorithms, run_of(rows, tasks, starts, **marked)))
    )
    won = run_of([(*row[:3], 1) for row in rows], tasks, starts, **marked)
    check_labels(plot_step_curves(dict.fromkeys(algorithms, won)))
    nodes, numbers = np.random.default_rng(0).normal(size=(50, 8)), np.arange(50)
    check_labels(plot_gwr_pca(nodes, numbers % (n_tasks + 1) - 1, tasks, numbers % n_tasks))
    panels = {f"Dist-NLL + demonstrations {number}": np.eye(n_tasks) for number in range(5)}
    check_labels(plot_success_matrices(panels, tasks), 5 * n_tasks**2)


NAN = np.nan
FIRST, SECOND = [[0.75, NAN], [0.5, 1.0]], [[0.25, NAN], [0.0, 0.125]]


def test_a_panel_shows_the_matrix_as_colors_and_numbers():
    figure = plot_success_matrices(
        {"one": np.array(FIRST), "two": np.array(SECOND)}, ["grasp_glass", "lift_green"]
    )
    one, two = (axes for axes in figure.axes if axes.images)
    assert (one.get_title(), two.get_title()) == ("one", "two")
    for panel, matrix in ((one, FIRST), (two, SECOND)):
        np.testing.assert_array_equal(np.ma.filled(panel.images[0].get_array(), NAN), matrix)
        assert panel.images[0].get_clim() == (0, 1)
    numbers = {text.get_position(): text.get_text() for text in one.texts}
    assert numbers == {(0, 0): "75", (0, 1): "50", (1, 1): "100"}  # column and row, from the top
    rows = [label.get_text() for label in one.get_yticklabels()]
    assert rows == ["1: grasp glass", "2: lift green"]
    assert [label.get_text() for label in two.get_yticklabels()] == ["1", "2"]


REFUSED = {
    "no steps to plot": lambda: plot_step_curves({"none": run_of([(0, 1, "a", 0)], "a")}),
    "nothing to show": lambda: plot_frame_strips({"none": np.zeros((0, 2, 2, 3), np.uint8)}),
    "uint8 [T, H, W, 3]": lambda: save_gif(np.zeros((1, 2, 3, 3)), "none.gif"),
}


@pytest.mark.parametrize("cause", REFUSED)
def test_what_cannot_be_drawn_is_refused(cause):
    with pytest.raises(ValueError, match=re.escape(cause)):
        REFUSED[cause]()
