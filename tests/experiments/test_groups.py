"""Groups that form from demonstrations, and detection of unknown tasks, on the shipped bank."""

import json

import pytest
import torch

from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.experiments import groups
from bgpo_trl.experiments.unknown_task import UnknownTaskArguments, unknown_task
from bgpo_trl.transforms import TaskSchedule


def test_draws_are_of_the_tasks_available():
    task = torch.tensor([0, 1, 0, 1, 2, 2])
    bank = DemonstrationBank(torch.zeros(6, 2), task, torch.ones(6, dtype=torch.bool))
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


@pytest.mark.parametrize("scale", [1.0, 0.1])
def test_the_shipped_tasks_form_six_pure_groups_in_every_schedule(scale):
    table = groups.groups(groups.GroupsArguments(draws=900, seeds=(0,), scale=scale))
    _, _, *rows = table.splitlines()
    cells = [[cell.strip() for cell in row.split("|")[1:-1]] for row in rows]
    schedules = ["one after the other", "in reverse", "the newest only", "from the start"]
    assert [row[0] for row in cells] == schedules
    assert all(row[1:3] == ["6", "100"] for row in cells)
    assert all(1 < int(row[3]) <= 60 and float(row[6]) > 95 for row in cells)


def test_each_shipped_task_is_detected_when_it_is_left_out(tmp_path):
    unknown_task(UnknownTaskArguments(seeds=(0,), draws=200, out=tmp_path))
    found = json.loads((tmp_path / "unknown_task.json").read_text())
    assert len(found) == 3
    for task, measured in found.items():
        assert measured["area"][0] > 0.95, task
    assert (tmp_path / "roc.png").stat().st_size > 1000
