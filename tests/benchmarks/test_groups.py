"""The benchmark of groups: what it shows to the networks, and the shipped bank's table."""

import pytest
import torch

from benchmarks import groups
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.transforms import TaskSchedule


def test_draws_are_of_the_tasks_available_and_of_the_seed_alone():
    task = torch.tensor([0, 1, 0, 1, 2, 2])
    bank = DemonstrationBank(torch.zeros(6, 2), task, torch.ones(6, dtype=torch.bool))
    schedule = TaskSchedule((0, 20, 40))
    rows = torch.tensor([*groups.draw(bank, schedule, 200, 4)])
    drawn = task[rows]
    assert drawn[:20].unique().tolist() == [0] and drawn[20:40].unique().tolist() == [0, 1]
    assert drawn[40:].unique().tolist() == [0, 1, 2]
    assert rows.unique().tolist() == list(range(6))
    newest = TaskSchedule((0, 20, 40), cumulative=False)
    drawn = task[torch.tensor([*groups.draw(bank, newest, 60, 4)])]
    assert drawn.equal(torch.arange(3).repeat_interleave(20))


def test_a_task_has_its_own_group_if_most_of_both_are_the_others():
    task = torch.tensor([0, 0, 0, 1, 1, 1, 2])
    assert groups.own_groups(torch.tensor([0, 0, 2, 0, 1, 1, 1]), task) == {0, 1}
    assert groups.own_groups(torch.zeros(7, dtype=torch.int64), task) == {0}


@pytest.mark.parametrize("scale", [1.0, 0.1])
def test_the_shipped_tasks_form_pure_groups_one_for_each_side(capsys, scale):
    groups.main(groups.Arguments(draws=900, seeds=(0,), scale=scale))
    _, _, *rows = capsys.readouterr().out.splitlines()
    cells = [[cell.strip() for cell in row.split("|")[1:-1]] for row in rows]
    assert [row[0] for row in cells] == [
        "one after the other",
        "in reverse",
        "the newest only",
        "from the start",
    ]
    assert all(row[1:3] == ["6", "100"] for row in cells)
    assert all(1 < int(row[3]) <= 60 and float(row[6]) > 95 for row in cells)
