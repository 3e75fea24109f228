"""Detection of tasks that were never shown."""

import json

import torch
from unknown_task import (
    Detection,
    UnknownTaskArguments,
    leave_one_out,
    roc_area,
    roc_curve,
    unknown_task,
)

from tests.experiments.places import places


def test_each_shipped_task_is_detected_when_it_is_left_out(tmp_path):
    unknown_task(UnknownTaskArguments(seeds=(0,), draws=200, out=tmp_path))
    found = json.loads((tmp_path / "unknown_task.json").read_text())
    assert len(found) == 3
    for task, measured in found.items():
        assert measured["area"][0] > 0.95, task
    assert (tmp_path / "roc.png").stat().st_size > 1000


def test_the_roc_area_equals_the_integral_of_the_roc_curve():
    generator = torch.Generator().manual_seed(0)
    known = torch.rand(50, generator=generator).round(decimals=1)  # with ties
    unknown = torch.rand(30, generator=generator).round(decimals=1) * 1.2
    false_alarms, detected = roc_curve(known, unknown)
    assert (false_alarms[0], detected[0]) == (0, 0)
    assert (false_alarms[-1], detected[-1]) == (1, 1)
    expected = torch.trapezoid(detected, false_alarms)
    torch.testing.assert_close(roc_area(known, unknown), expected)


def test_detections_are_counted_by_network():
    known = torch.tensor([[0.2, 0.8, 0.8, 1.4], [0.2, 0.2, 0.2, 1.0]])
    unknown = torch.tensor([[1.5, 0.7], [1.2, 1.4]])
    found = Detection(known, unknown)
    assert found.false_alarms.tolist() == [0.25, 0.0]
    assert found.detected.tolist() == [0.5, 1.0]
    assert found.area.tolist() == [5 / 8, 1.0]


def test_only_a_task_with_other_embeddings_is_detected():
    apart = places((0.0, 0.0), (3.0, 0.0), (0.0, 3.0))
    found = leave_one_out(apart, 2, seeds=range(10), draws=100)
    assert found.known.shape == (10, 20) and found.unknown.shape == (10, 10)
    assert (found.area == 1).all() and (found.detected == 1).all()
    assert found.false_alarms.mean() < 0.03  # by definition, some 1 % of what is known
    same = places((0.0, 0.0), (3.0, 0.0), (3.0, 0.0))
    found = leave_one_out(same, 2, seeds=[0], draws=100)
    assert 0.2 < found.area.item() < 0.8 and found.detected.item() == 0.0
