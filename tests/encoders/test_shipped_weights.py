"""Which of the shipped encoders serve which tasks, runs and banks."""

import shutil
from pathlib import Path

import pytest

from bgpo_trl.encoders import pretrained, train
from bgpo_trl.encoders.pretrained import load_pretrained
from bgpo_trl.encoders.representation import load_representation
from bgpo_trl.experiments.run import pretrained_for
from bgpo_trl.runs.config_file import Digests
from bgpo_trl.runs.demonstrations import keep_inputs, load_inputs
from suites import nico

META = {"scene": "nico", "spread": 0.5}


@pytest.mark.parametrize(
    ("tasks", "name"),
    [
        (nico.PAPER_TASKS, "nico"),
        (("grasp_glass",), "nico"),
        (("juggle", "grasp_glass"), "nico"),
        (nico.ALL_TASKS, "nico_eight"),
        (("press_white",), "nico_eight"),
        (("juggle", "press_white"), "nico_eight"),
    ],
)
def test_tasks_outside_the_paper_use_the_encoders_of_eight_tasks(tasks, name):
    path = pretrained.default_weights(tasks)
    assert path.parts[-3:] == ("bgpo_trl", "weights", f"{name}.safetensors")
    encoders, bank = load_pretrained(tasks=tasks)
    assert encoders.identity == load_representation(path).identity
    assert {*tasks} - {"juggle"} <= {*bank.tasks}


@pytest.mark.parametrize("tasks", [nico.PAPER_TASKS, nico.ALL_TASKS])
@pytest.mark.parametrize("given", [None, Path("other.safetensors")])
def test_training_writes_the_encoders_of_the_datasets_tasks(monkeypatch, tasks, given):
    written = []
    monkeypatch.setattr(train, "load_demonstrations", lambda path: path)
    monkeypatch.setattr(train, "read_meta", lambda path: META | {"tasks": tasks})
    monkeypatch.setattr(
        train,
        "train_encoders",
        lambda dataset, play, weights, *_, tasks, spread, keep, scene: written.append(
            (weights, tasks, spread)
        ),
    )
    train.main(train.Arguments(Path("data"), weights=given))
    assert written == [(given or pretrained.default_weights(tasks), tasks, 0.5)]


def test_a_run_finds_its_encoders_by_their_digest(tmp_path):
    for tasks in (nico.PAPER_TASKS, nico.ALL_TASKS):
        encoders, bank = load_pretrained(tasks=tasks)
        paper = bank.for_tasks(nico.PAPER_TASKS)
        keep_inputs(tmp_path, paper, encoders)
        digests = Digests(encoders.identity, paper.identity)
        found, demonstrations = load_inputs(tmp_path, nico.PAPER_TASKS, digests)
        assert found.identity == encoders.identity
        assert demonstrations.identity == paper.identity
    assert not any(tmp_path.iterdir())  # Both come with the package.


def test_a_bank_is_used_with_the_encoders_that_embedded_it(tmp_path):
    path = tmp_path / "bank.safetensors"
    for tasks in (nico.PAPER_TASKS, nico.ALL_TASKS):
        weights = pretrained.default_weights(tasks)
        shutil.copy(pretrained.bank_path(weights), path)
        assert pretrained.weights_of_bank(path) == weights
        encoders, bank = pretrained_for(nico.PAPER_TASKS, path)
        assert encoders.identity == load_representation(weights).identity
        assert bank.tasks == nico.PAPER_TASKS


def test_an_unreadable_bank_gets_the_default_encoders(tmp_path: Path):
    assert pretrained.weights_of_bank(tmp_path / "nothing") == pretrained.default_weights()
    (tmp_path / "rubbish").write_bytes(b"rubbish")
    assert pretrained.weights_of_bank(tmp_path / "rubbish") == pretrained.default_weights()
