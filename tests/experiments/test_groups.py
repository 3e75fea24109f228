"""Groups that form from demonstrations."""

import pytest
import torch

from bgpo_trl.configs.runs import PAPER_TASKS
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.experiments import groups
from bgpo_trl.transforms import TaskSchedule
from tests.helpers import cells


def places(*centers):
    """A bank with one task around each center, every fourth demonstration held out."""
    generator = torch.Generator().manual_seed(1)
    task = torch.arange(len(centers)).repeat_interleave(40)
    noise = 0.05 * torch.randn(len(task), 2, generator=generator)
    embedding = torch.tensor(centers)[task] + noise
    train = torch.arange(len(task)) % 4 != 0
    names = tuple(f"task{i}" for i in range(len(centers)))
    return DemonstrationBank(embedding, task, train, names)


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
    monkeypatch.setattr(groups, "bank_of", lambda arguments: bank)
    printed = groups.groups(groups.GroupsArguments(draws=200, seeds=(0,)))
    last = printed.splitlines()[-1]
    assert last.startswith("task0 and task1 share a group in 4 of 4: show more demonstrations")


@pytest.mark.parametrize(("evidence", "n_groups"), [(1.0, "2"), (0.6, "3")])
def test_less_evidence_parts_tasks_that_are_close(evidence, n_groups, monkeypatch):
    bank = places((0.0, 0.0), (0.2, 0.0), (9.0, 0.0))
    monkeypatch.setattr(groups, "bank_of", lambda arguments: bank)
    arguments = groups.GroupsArguments(draws=300, seeds=(0,), group_evidence=evidence)
    assert cells(groups.groups(arguments))[1][1] == n_groups


def test_the_shipped_tasks_form_six_pure_groups_in_every_schedule():
    table = groups.groups(groups.GroupsArguments(draws=900, seeds=(0,)))
    rows = cells(table)[1:]
    schedules = ["one after the other", "in reverse", "the newest only", "from the start"]
    assert [row[0] for row in rows] == schedules
    assert all(row[1:3] == ["6", "100"] for row in rows)
    assert all(1 < int(row[3]) <= 60 and float(row[6]) > 95 for row in rows)
