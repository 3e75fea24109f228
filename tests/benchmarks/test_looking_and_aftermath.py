"""The test of looking and the aftermath of successes, as commands."""

import csv
import json
import shutil
from dataclasses import replace

import aftermath
import looking
import pytest

from bgpo_trl.algorithms.bgpo import BGPO
from bgpo_trl.experiments.episodes import load_blocks
from bgpo_trl.training import Trainer
from suites import nico

TASKS = nico.PAPER_TASKS
CONDITIONS = ("seen", "places hidden", "objects hidden", "random actions")


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("name", ["bgpo", "maml", "dist-nll"])
def test_every_seed_is_tested_in_every_condition(run_of, tmp_path, capsys, name):
    out = tmp_path / "out"
    looking.main(looking.Arguments(run_of(name), episodes=1, out=out))
    rows = rows_of(out / "looking.csv")
    assert [(row["condition"], row["seed"], row["task"]) for row in rows] == [
        (condition, seed, task) for condition in CONDITIONS for seed in "38" for task in TASKS
    ]
    assert {row["success"] for row in rows} <= {"0.0", "1.0"}
    assert (out / "looking.png").read_bytes().startswith(b"\x89PNG")
    assert set(json.loads((out / "looking.json").read_text())) == {"commit", "command"}
    lines = [line.split("|")[1:-1] for line in capsys.readouterr().out.splitlines()]
    assert [cell.strip() for cell in lines[0]] == ["success, %", *CONDITIONS]
    assert [cells[0].strip() for cells in lines[2:]] == [*TASKS, "all"]


@pytest.fixture
def trained(bank, encoders, make_config, monkeypatch, tmp_path):
    """Trains a run on the ground truth."""
    place = "bgpo_trl.runs.demonstrations.load_representation"
    monkeypatch.setattr(place, lambda path, scene_version: encoders)

    def train(name="rung a", encoders=encoders):
        directory = tmp_path / "run"
        config = replace(make_config("state", "oracle", episodes=4), name=name)
        parts = {"bank": bank, "encoders": encoders, "make": BGPO, "progress": False}
        with Trainer(config, directory, **parts) as trainer:
            trainer.run()
        return directory

    return train


@pytest.mark.parametrize("name", ["rung a", "oracle"])
def test_runs_on_the_ground_truth_are_tested_too(trained, tmp_path, name):
    run = trained(name)
    looking.main(looking.Arguments(run, episodes=1))
    assert len(rows_of(run / "looking.csv")) == len(CONDITIONS) * 2 * 3


def test_a_run_without_encoders_is_refused_in_a_line(trained, refused):
    run = trained("oracle", encoders=None)
    refused(
        lambda: looking.main(looking.Arguments(run, episodes=1)),
        "was trained without encoders",
        "give its Trainer encoders",
    )


def test_a_merged_run_is_tested_by_its_blocks(run_of):
    run = run_of("bgpo")
    assert [loaded.config.seeds for loaded in load_blocks(run)] == [(3, 8)]
    merged = run.parent / "merged"
    for block in ("seeds-3-8", "seeds-3-8-again"):
        shutil.copytree(run, merged / block)
    shutil.copy(run / "config.json", merged)
    assert [loaded.config.seeds for loaded in load_blocks(merged)] == [(3, 8), (3, 8)]


def test_the_aftermath_of_each_success_is_told(run_of, tmp_path, capsys):
    """Of the demonstrators', since untrained policies have none."""
    run, out = run_of("oracle"), tmp_path / "out"
    config = json.loads((run / "config.json").read_text())
    config["algorithm"]["max_steps"] = 50
    (run / "config.json").write_text(json.dumps(config))
    aftermath.main(aftermath.Arguments(run, demonstrators=True, episodes=1, out=out))
    rows = rows_of(out / "aftermath.csv")
    told = [line.split("|")[1:-1] for line in capsys.readouterr().out.splitlines()[2:]]
    told = [[cell.strip() for cell in cells] for cells in told]
    actors = ("policy", "demonstrators", "random actions")
    assert [cells[:2] for cells in told] == [[actor, task] for actor in actors for task in TASKS]
    for actor, task, successes, *_ in told:
        found = [row for row in rows if (row["actor"], row["task"]) == (actor, task)]
        assert successes == f"{len(found)} of 2"
    of_demonstrators = [row for row in rows if row["actor"] == "demonstrators"]
    assert len(of_demonstrators) >= 4
    assert {row["holds"] for row in of_demonstrators} <= {"True", "False"}
    assert set(json.loads((out / "aftermath.json").read_text())) == {"commit", "command"}


def test_demonstrators_need_no_run(monkeypatch, tmp_path):
    monkeypatch.setattr(nico, "ALL_TASKS", ("press_white",))
    arguments = aftermath.Arguments(demonstrators=True, episodes=1, seeds=(4,), out=tmp_path)
    episodes = aftermath.episodes_of(arguments)
    assert {actor: len(found) for actor, found in episodes.items()} == {
        "demonstrators": 1,
        "random actions": 1,
    }
    first, second = (found[0] for found in episodes.values())
    assert (first.start == second.start).all()
    assert first.seed == 4
