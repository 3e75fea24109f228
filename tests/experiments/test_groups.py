"""Groups that form from demonstrations, and detection of unknown tasks."""

import json

import torch

from bgpo_trl.configs.runs import PAPER_TASKS
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.experiments import groups, run
from bgpo_trl.experiments.groups import (
    Detection,
    UnknownTaskArguments,
    leave_one_out,
    roc_area,
    roc_curve,
    unknown_task,
)
from bgpo_trl.transforms import TaskSchedule
from tests.helpers import cells


def test_draws_are_of_the_tasks_available():
    task = torch.tensor([0, 1, 0, 1, 2, 2])
    bank = DemonstrationBank(torch.zeros(6, 2), task, torch.ones(6, dtype=torch.bool), PAPER_TASKS)
    rows = torch.tensor([*groups.draw(bank, TaskSchedule((0, 20, 40)), 200, 4)])
    drawn = task[rows]
    assert drawn[:20].unique().tolist() == [0] and drawn[20:40].unique().tolist() == [0, 1]
    assert drawn[40:].unique().tolist() == [0, 1, 2]
    assert rows.unique().tolist() == list(range(6))
    newest = TaskSchedule((0, 20, 40), cumulative=False)
    drawn = task[torch.tensor([*groups.draw(bank, newest, 60, 4)])]
    assert drawn.equal(torch.arange(3).repeat_interleave(20))


def test_a_task_owns_a_group_if_most_of_both_are_in_common():
    task = torch.tensor([0, 0, 0, 1, 1, 1, 2])
    assert groups.own_groups(torch.tensor([0, 0, 2, 0, 1, 1, 1]), task) == {0, 1}
    assert groups.own_groups(torch.zeros(7, dtype=torch.int64), task) == {0}


def test_tasks_share_a_group_that_holds_more_than_a_tenth_of_each():
    task = torch.tensor([0] * 10 + [1] * 5 + [2] * 10)
    group = torch.tensor([0] * 10 + [0, 0, 1, 1, 1] + [1, *[2] * 9])
    assert groups.sharing(group, task) == {(0, 1)}  # a tenth of task 2 is not more than a tenth
    assert groups.sharing(torch.zeros_like(task), task) == {(0, 1), (0, 2), (1, 2)}
    assert groups.sharing(task, task) == set()


def test_the_command_names_the_tasks_that_share_a_group(monkeypatch):
    bank = places((0.0, 0.0), (0.0, 0.0), (3.0, 0.0))
    monkeypatch.setattr(run, "bank_of", lambda arguments: bank)
    printed = groups.groups(groups.GroupsArguments(draws=200, seeds=(0,)))
    assert printed.splitlines()[-1] == "task0 and task1 share a group in 4 of 4."


def test_the_shipped_tasks_form_six_pure_groups_in_every_schedule():
    table = groups.groups(groups.GroupsArguments(draws=900, seeds=(0,)))
    rows = cells(table)[1:]
    schedules = ["one after the other", "in reverse", "the newest only", "from the start"]
    assert [row[0] for row in rows] == schedules
    assert all(row[1:3] == ["6", "100"] for row in rows)
    assert all(1 < int(row[3]) <= 60 and float(row[6]) > 95 for row in rows)


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


def places(*centers, n=40, spread=0.05):
    """A bank with one task around each center, every fourth demonstration held out."""
    generator = torch.Generator().manual_seed(1)
    task = torch.arange(len(centers)).repeat_interleave(n)
    noise = spread * torch.randn(len(task), 2, generator=generator)
    embedding = torch.tensor(centers)[task] + noise
    train = torch.arange(len(task)) % 4 != 0
    names = tuple(f"task{i}" for i in range(len(centers)))
    return DemonstrationBank(embedding, task, train, names)


def test_only_a_task_with_other_embeddings_is_detected():
    apart = places((0.0, 0.0), (3.0, 0.0), (0.0, 3.0))
    found = leave_one_out(apart, 2, seeds=[0, 1], draws=100)
    assert found.known.shape == (2, 20) and found.unknown.shape == (2, 10)
    assert found.area.tolist() == [1.0, 1.0]
    assert found.detected.tolist() == [1.0, 1.0] and found.false_alarms.tolist() == [0.0, 0.0]
    same = places((0.0, 0.0), (3.0, 0.0), (3.0, 0.0))
    found = leave_one_out(same, 2, seeds=[0], draws=100)
    assert 0.2 < found.area.item() < 0.8 and found.detected.item() == 0.0


def test_a_seed_in_a_batch_equals_the_seed_alone():
    bank = places((0.0, 0.0), (3.0, 0.0), (0.0, 3.0), spread=0.5)
    both = leave_one_out(bank, 0, seeds=[3, 4], draws=50)
    alone = leave_one_out(bank, 0, seeds=[4], draws=50)
    torch.testing.assert_close(both.known[1:], alone.known)
