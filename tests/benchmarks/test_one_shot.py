"""Success against the share of the demonstration that was seen."""

import csv
import json
from types import SimpleNamespace

import numpy as np
import one_shot
import pytest
import torch

from bgpo_trl import load_run
from bgpo_trl.data.recording import record_demonstrations
from suites import nico

TASKS = nico.PAPER_TASKS


def test_every_seed_is_tested_with_every_share_of_every_task(run_of, tmp_path, capsys):
    arguments = one_shot.Arguments(run_of("bgpo"), (0.5, 1.0), episodes=2, out=tmp_path / "out")
    one_shot.main(arguments)
    with (tmp_path / "out" / "one_shot.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["share"], row["seed"], row["task"]) for row in rows] == [
        (share, seed, task) for share in ("0.5", "1.0") for seed in "38" for task in TASKS
    ]
    for row in rows:
        assert row["episodes"] == "2"
        assert float(row["success"]) in (0, 0.5, 1)
        assert float(row["task_inference"]) in (0, 0.5, 1)
        assert 0 < float(row["activity"]) < 1
    assert (tmp_path / "out" / "one_shot.png").read_bytes().startswith(b"\x89PNG")
    assert set(json.loads((tmp_path / "out" / "one_shot.json").read_text())) == {
        "commit",
        "command",
    }
    lines = capsys.readouterr().out.splitlines()
    assert [line.split("|")[1:3] for line in lines[2:]] == [
        [f" {task} ", f" {share} "] for task in ("all", *TASKS) for share in ("50%", "100%")
    ]


@pytest.mark.parametrize("name", ["oracle", "none"])
def test_without_gwr_b_there_is_nothing_to_infer(run_of, tmp_path, capsys, name):
    one_shot.main(one_shot.Arguments(run_of(name), (1.0,), episodes=1, out=tmp_path))
    with (tmp_path / "one_shot.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 6
    assert {(row["task_inference"], row["activity"]) for row in rows} == {("", "")}
    for line in capsys.readouterr().out.splitlines()[2:]:
        assert [cell.strip() for cell in line.split("|")[4:]] == ["", "", ""]


def test_policies_are_shown_the_beginning_of_new_demonstrations(run_of, tmp_path, monkeypatch):
    policy = load_run(run_of("bgpo"))
    told = []
    snapshot = policy.algorithm.snapshot

    def spy(index, embedding, task, generator):
        told.append((index, embedding, task))
        return snapshot(index, embedding, task, generator)

    monkeypatch.setattr(policy.algorithm, "snapshot", spy)
    rows = one_shot.measure(policy, (0.3, 1.0), 2, 4)
    shown = record_demonstrations(
        tmp_path / "again", per_task=2, held_out_per_task=0, seed=4, progress=False
    )
    monkeypatch.undo()
    assert [index for index, _, _ in told] == [0, 1, 0, 1]
    gwr, seen = policy.algorithm.gwr, policy.bank.seen()
    for share, (_, embedding, task) in zip((0.3, 1.0), told[::2], strict=True):
        assert task.tolist() == [[0, 0], [1, 1], [2, 2]]
        for row in range(6):
            n_frames = round(share * int(shown["length"][row]))
            expected = policy.condition(shown["pixels"][row, :n_frames].numpy()).embedding
            assert torch.allclose(embedding[row // 2, row % 2], expected, atol=1e-5)
        for index in range(2):
            weights = gwr.graph(index).weights
            nearest = [int((weights - phi).norm(dim=-1).argmin()) for phi in seen.embedding]
            for label in range(3):
                inferred, activity = [], []
                for phi in embedding[label]:
                    distance, node = (weights - phi).norm(dim=-1).min(0)
                    tasks = [
                        t for n, t in zip(nearest, seen.task.tolist(), strict=True) if n == node
                    ]
                    majority = max(range(3), key=tasks.count) if tasks else -1
                    inferred.append(majority == label)
                    activity.append(float(torch.exp(-0.25 * distance)))  # activity_scale
                (found,) = [
                    row
                    for row in rows
                    if row[:3] == (share, policy.config.seeds[index], TASKS[label])
                ]
                assert found[5:] == pytest.approx((np.mean(inferred), np.mean(activity)), abs=1e-5)


def test_all_shares_are_tested_from_the_same_starts(run_of, monkeypatch):
    policy, numbers = load_run(run_of("bgpo")), []

    def run(self, snapshots, device):
        numbers.extend({snapshot.number for snapshot in snapshots})
        assert all(snapshot.presented.all() for snapshot in snapshots)
        return SimpleNamespace(success=torch.ones(2, 3, 1, dtype=torch.bool))

    monkeypatch.setattr(one_shot.Evaluator, "run", run)
    rows = one_shot.measure(policy, (0.5, 0.7, 1.0), 1, 1)
    assert len(numbers) == 3 and len(set(numbers)) == 1
    assert {row[4] for row in rows} == {1.0}


def table():
    rows = [
        (0.5, 0, "a", 4, 0.25, 1.0, 0.5),
        (0.5, 0, "b", 4, 0.75, 0.0, 0.7),
        (0.5, 1, "a", 4, 0.0, 0.5, 0.5),
        (0.5, 1, "b", 4, 0.5, 0.5, 0.5),
        (1.0, 0, "a", 4, 1.0, 1.0, 1.0),
        (1.0, 1, "a", 4, 0.5, 1.0, 1.0),
        (1.0, 0, "b", 4, 1.0, 1.0, 1.0),
        (1.0, 1, "b", 4, 1.0, 1.0, 1.0),
    ]
    return one_shot.means(rows)


def test_means_by_hand():
    means = table()
    assert list(means) == ["all", "a", "b"]
    assert means["all"][0.5] == pytest.approx(np.array([[0.5, 0.5, 0.6], [0.25, 0.5, 0.5]]))
    assert means["a"][1.0] == pytest.approx(np.array([[1, 1, 1], [0.5, 1, 1]]))


def test_the_figure_shows_them():
    success, inferred = one_shot.plot(table()).axes
    curves = {line.get_label(): np.array(line.get_data()).T.tolist() for line in success.lines}
    assert curves == {
        "all": [[0.5, 0.375], [1.0, 0.875]],
        "a": [[0.5, 0.125], [1.0, 0.75]],
        "b": [[0.5, 0.625], [1.0, 1.0]],
    }
    assert inferred.lines[1].get_ydata().tolist() == [0.75, 1.0]
    (band,) = success.collections
    edges = band.get_paths()[0].vertices
    assert sorted(set(edges[edges[:, 0] == 0.5, 1])) == pytest.approx([0.25, 0.5])


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"shares": (0.5, 1.2)}, r"--shares are in \(0, 1\], got 0.5, 1.2"),
        ({"shares": (0.0,)}, r"--shares are in \(0, 1\], got 0.0"),
        ({"shares": (float("nan"),)}, r"--shares are in \(0, 1\], got nan"),
        ({"shares": ()}, r"--shares are in \(0, 1\], got none"),
        ({"episodes": 0}, "--episodes must be at least 1, got 0"),
    ],
)
def test_what_cannot_be_tested_is_refused(run_of, tmp_path, changes, said):
    arguments = one_shot.Arguments(run_of("bgpo"), out=tmp_path / "out", **changes)
    with pytest.raises(ValueError, match=said):
        one_shot.main(arguments)
    assert not (tmp_path / "out").exists()
