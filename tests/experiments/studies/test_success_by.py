"""Success by the setting in which alone runs differ."""

import numpy as np
import pytest
from success_by import ByArguments, plot_by, success_by

from tests.analysis.runs import TASKS, write_run
from tests.helpers import cells, edit


def test_success_is_shown_by_the_setting_in_which_runs_differ(tmp_path):
    for spread, level in ((1.0, [5, 7, 6]), (0.25, [9, 9, 9]), (0.0, [10, 10, 10])):
        write_run(tmp_path, "bgpo", level, directory=f"spread-{spread}", spread=spread)
    edit(tmp_path / "spread-1.0" / "summary.json", random_success=dict.fromkeys(TASKS, 0.04))
    out = tmp_path / "out"
    text = success_by(ByArguments((tmp_path,), out=out))
    assert text == (out / "tables.md").read_text()
    found = {row[0]: row[1:] for row in cells(text)[1:]}
    assert [*found] == ["0", "0.25", "1"]
    assert found["0"] == ["3", *["100.0"] * 4, "-"]
    assert found["1"] == ["3", *["60.0 [35, 85]"] * 4, "4 4 4"]
    assert (out / "by-spread.png").exists()


@pytest.mark.parametrize(
    ("name", "changes", "cause"),
    [
        ("oracle", {"spread": 0.5}, "one algorithm"),
        ("bgpo", {"spread": 0.5, "held_out": "test"}, "held_out"),
        ("bgpo", {"spread": 1.0}, "have 1.0"),
        ("bgpo", {"spread": "wide"}, "no number"),
        ("bgpo", {}, "no number"),
    ],
)
def test_runs_that_differ_in_more_than_one_number_are_refused(
    name, changes, cause, tmp_path, refused
):
    write_run(tmp_path, "bgpo", 9, directory="a", spread=1.0)
    write_run(tmp_path, name, 9, directory="b", **changes)
    refused(lambda: success_by(ByArguments((tmp_path,), out=tmp_path / "report")), cause, "")


def test_lines_pass_through_the_means_and_dots_are_seeds():
    success = {1.0: [[0.2, 0.9], [0.6, 0.7]], 0.0: [[1.0, 0.5], [0.8, 0.5]]}
    figure = plot_by(success, ["grasp_glass", "lift_green"], label="Spread")
    (axes,) = figure.axes
    lines = {str(line.get_label()): line.get_xydata() for line in axes.lines}
    assert lines["grasp glass"] == pytest.approx(np.array([[0, 0.9], [1, 0.4]]))
    assert lines["lift green"] == pytest.approx(np.array([[0, 0.5], [1, 0.8]]))
    dots = np.concatenate([found.get_offsets() for found in axes.collections])
    expected = [(number, rate) for number, scores in success.items() for rate in np.ravel(scores)]
    assert sorted(map(tuple, dots.tolist())) == sorted(expected)
    assert axes.get_xlabel() == "Spread"
