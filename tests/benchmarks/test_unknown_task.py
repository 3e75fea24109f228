"""The benchmark of unknown tasks on the shipped bank."""

import json

from benchmarks import unknown_task


def test_each_of_the_shipped_tasks_is_detected_when_left_out(tmp_path):
    unknown_task.main(unknown_task.Arguments(seeds=(0,), draws=200, out=tmp_path))
    found = json.loads((tmp_path / "unknown_task.json").read_text())
    assert len(found) == 3
    for task, measured in found.items():
        assert measured["area"][0] > 0.95, task
    assert (tmp_path / "roc.png").stat().st_size > 1000
