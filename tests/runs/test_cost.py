"""Costs of training, against sums worked out by hand."""

import torch

from bgpo_trl.runs.cost import CostLog

STATE = {"a": torch.zeros(3), "b": [{"c": torch.zeros(2, dtype=torch.int64)}, 7, None, "x"]}


def test_costs_are_summed_by_the_number_of_tasks_also_when_resumed(tmp_path):
    path = tmp_path / "cost.csv"
    log = CostLog(path)
    for tasks, seconds in ((1, 0.25), (1, 0.5), (2, 1.0)):
        log.add_step(tasks, seconds)
    log.measure(1, STATE)  # 3 numbers of 4 bytes and 2 of 8
    log.write()
    lines = ["tasks,steps,seconds,megabytes", "1,2,0.750,0.000028", "2,1,1.000,0.000000"]
    assert path.read_text().splitlines() == lines
    resumed = CostLog(path, resume=True)
    resumed.add_step(2, 0.5)
    resumed.write()
    assert path.read_text().splitlines() == [*lines[:2], "2,2,1.500,0.000000"]
