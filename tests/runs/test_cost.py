"""Costs of training, against sums worked out by hand."""

import pytest
import torch

from bgpo_trl.runs.cost import CostLog, read_costs

STATE = {"a": torch.zeros(3), "b": [{"c": torch.zeros(2, dtype=torch.int64)}, 7, None, "x"]}


def test_costs_are_summed_by_the_number_of_tasks(tmp_path):
    log = CostLog(tmp_path / "cost.csv")
    for tasks, seconds in ((1, 0.25), (1, 0.5), (2, 1.0)):
        log.add_step(tasks, seconds)
    log.measure(1, STATE)  # 3 numbers of 4 bytes and 2 of 8
    log.write()
    lines = (tmp_path / "cost.csv").read_text().splitlines()
    assert lines == ["tasks,steps,seconds,megabytes", "1,2,0.750,0.000028", "2,1,1.000,0.000000"]
    assert read_costs(tmp_path / "cost.csv") == log.costs


@pytest.mark.parametrize("row", ["1,2,-3,4", "1,2.5,3,4"])
def test_a_damaged_file_is_refused(tmp_path, row):
    path = tmp_path / "cost.csv"
    path.write_text(f"tasks,steps,seconds,megabytes\n{row}\n")
    with pytest.raises(ValueError, match=r"cost\.csv, line 2 is damaged: remove the file, and"):
        CostLog(path, resume=True)
    assert path.read_text().endswith(f"\n{row}\n")
