"""The benchmark of groups: what it feeds to the networks, and the shipped bank's table."""

import torch

from benchmarks import groups
from bgpo_trl.data.bank import DemonstrationBank


def test_draws_are_of_the_tasks_presented_so_far_and_of_the_seed_alone():
    task = torch.tensor([0, 1, 0, 1, 2, 2])
    bank = DemonstrationBank(torch.zeros(6, 2), task, torch.ones(6, dtype=torch.bool))
    rows = groups.draw(bank, [0, 20, 40], draws=200, seeds=[3, 4])
    drawn = task[rows]
    assert drawn[:20].unique().tolist() == [0] and drawn[20:40].unique().tolist() == [0, 1]
    assert drawn[40:].unique().tolist() == [0, 1, 2]
    assert rows.unique().tolist() == list(range(6))
    assert groups.draw(bank, [0, 20, 40], draws=200, seeds=[4]).flatten().equal(rows[:, 1])


def test_the_shipped_tasks_form_three_pure_groups(capsys):
    groups.main(groups.Arguments(thresholds=(0.525,), draws=300, seeds=(0,)))
    lines = capsys.readouterr().out.splitlines()
    coarse = [line for line in lines if "coarse" in line]
    assert coarse == [
        "| one after the other | coarse | 0.525 | 3 | 100 |",
        "| from the start | coarse | 0.525 | 3 | 100 |",
    ]
    fine = [float(line.split("|")[-2]) for line in lines if "| fine |" in line]
    assert len(fine) == 2 and min(fine) > 95
