"""Success against the share of the demonstration that is shown."""

import json
from itertools import product

import numpy as np
import one_shot
import pytest
import torch
from one_shot import OneShotArguments

from bgpo_trl import load_run
from bgpo_trl.analysis.task_inference import majority_task, match_counts
from bgpo_trl.data.recording import record_demonstrations
from suites import nico
from tests.helpers import cells, rows, spied

TASKS = nico.PAPER_TASKS


def test_every_seed_is_tested_with_every_share_of_every_task(run_of, tmp_path):
    arguments = OneShotArguments(
        run=run_of("bgpo"), shares=(0.5, 1.0), episodes=2, out=tmp_path / "out"
    )
    printed = one_shot.one_shot(arguments)
    found = rows(tmp_path / "out" / "one_shot.csv")
    conditions = [(row["share"], row["seed"], row["task"]) for row in found]
    assert conditions == [*product(("0.5", "1.0"), "38", TASKS)]
    for row in found:
        assert row["episodes"] == "2"
        assert float(row["success"]) in (0, 0.5, 1)
        assert float(row["task_inference"]) in (0, 0.5, 1)
        assert 0 < float(row["activity"]) < 1
    assert (tmp_path / "out" / "one_shot.png").exists()
    origin = json.loads((tmp_path / "out" / "one_shot.json").read_text())
    assert set(origin) == {"commit", "command"}
    shown = {(task, share): means for task, share, *means in cells(printed)[1:]}
    assert [*shown] == [*product(("all", *TASKS), ("50%", "100%"))]
    for (task, share), means in shown.items():
        of_share = [row for row in found if f"{float(row['share']):.0%}" == share]
        tested = [row for row in of_share if task in ("all", row["task"])]
        for name, mean in zip(("success", "task_inference"), means, strict=False):
            assert mean == f"{np.mean([float(row[name]) for row in tested]):.1%}"


def test_cells_of_gwr_are_empty_without_it(run_of, tmp_path):
    arguments = OneShotArguments(run=run_of("oracle"), shares=(1.0,), episodes=1, out=tmp_path)
    printed = one_shot.one_shot(arguments)
    found = [(row["task_inference"], row["activity"]) for row in rows(tmp_path / "one_shot.csv")]
    assert found == [("", "")] * 6
    assert all(row[3:] == ["", ""] for row in cells(printed)[1:])


def test_policies_are_shown_the_beginning_of_new_demonstrations(run_of, tmp_path, monkeypatch):
    policy = load_run(run_of("bgpo"))
    copied = spied(policy.algorithm, "snapshot", monkeypatch)
    table = one_shot.measure(policy, (0.3, 1.0), 2, 4).set_index(["share", "seed", "task"])
    shown = record_demonstrations(
        tmp_path / "again", per_task=2, held_out_per_task=0, seed=4, progress=False
    )
    monkeypatch.undo()
    assert [index for (index, *_), _ in copied] == [0, 1, 0, 1]
    gwr = policy.algorithm.gwr
    task_of_node = majority_task(match_counts(gwr, policy.bank.seen()))
    for share, ((_, embedding, task, _), _) in zip((0.3, 1.0), copied[::2], strict=True):
        assert task.tolist() == [[0, 0], [1, 1], [2, 2]]
        for row in range(6):
            n_frames = round(share * int(shown["length"][row]))
            expected = policy.condition(shown["pixels"][row, :n_frames].numpy()).embedding
            assert torch.allclose(embedding[row // 2, row % 2], expected, atol=1e-5)
        for index, seed in enumerate(policy.config.seeds):
            distance, node = torch.cdist(embedding, gwr.graph(index).weights).min(-1)
            activity = torch.exp(-0.25 * distance).mean(-1)  # activity_scale
            inferred = (task_of_node[index][node] == task).float().mean(-1)
            found = table.loc[(share, seed)].loc[[*TASKS]]
            assert found["activity"].tolist() == pytest.approx(activity.tolist(), abs=1e-5)
            assert found["task_inference"].tolist() == pytest.approx(inferred.tolist())


@pytest.mark.parametrize(
    "wrong", [{"shares": (0.5, 1.2)}, {"shares": (float("nan"),)}, {"shares": ()}, {"episodes": 0}]
)
def test_wrong_shares_and_numbers_of_episodes_are_refused(run_of, tmp_path, wrong):
    with pytest.raises(ValueError, match=r"--(shares|episodes)"):
        one_shot.one_shot(OneShotArguments(run=run_of("bgpo"), out=tmp_path / "out", **wrong))
    assert not (tmp_path / "out").exists()
