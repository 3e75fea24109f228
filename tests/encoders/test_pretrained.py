"""Encoders and the bank of their embeddings, which are made, shipped and loaded together."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from bgpo_trl.data.dataset import load_demonstrations, read_meta
from bgpo_trl.encoders import pretrained
from bgpo_trl.encoders.pretrained import load_pretrained
from bgpo_trl.encoders.representation import load_representation, save_representation
from bgpo_trl.encoders.train import make_pretrained
from bgpo_trl.experiments import make_data
from bgpo_trl.experiments.arguments import EncodersArguments
from bgpo_trl.experiments.run import pretrained_for
from bgpo_trl.modules.sequence_autoencoder import SequenceAutoencoder
from bgpo_trl.runs.config_file import Digests
from bgpo_trl.runs.demonstrations import BANK, keep_inputs, load_inputs, own_weights
from bgpo_trl.scenes import SCENES
from bgpo_trl.scenes.nico import NICO
from suites import nico
from tests.helpers import TINY_ENCODERS

TASKS = nico.PAPER_TASKS
REVERSED = TASKS[::-1]
ARGUMENTS = {
    "config": TINY_ENCODERS,
    "tasks": REVERSED,
    "per_task": 3,
    "held_out_per_task": 1,
    "progress": False,
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("pretrained")


@pytest.fixture(scope="module")
def made(folder):
    return make_pretrained(
        folder / "encoders" / "some.safetensors",
        folder / "demonstrations",
        folder=folder / "log",
        command="a command",
        **ARGUMENTS,
    )


def test_made_encoders_and_bank_are_loaded(made, folder):
    encoders, bank = made
    loaded_encoders, loaded_bank = load_pretrained(folder / "encoders" / "some.safetensors")
    assert loaded_encoders.identity == encoders.identity
    assert loaded_encoders.metadata["command"] == "a command"
    assert loaded_bank.tasks == bank.tasks == REVERSED
    for recorded in ("demonstrations", "demonstrations-play"):
        assert read_meta(folder / recorded)["tasks"] == [*REVERSED]
    assert loaded_bank.identity == bank.identity


def test_the_command_does_not_overwrite_shipped_weights_unasked(made, folder, monkeypatch):
    written = []
    monkeypatch.setattr(make_data, "train_encoders", lambda *given, **_: written.append(given[2]))
    monkeypatch.setattr(make_data, "verdict_in", lambda of, _: f"verdict in {of}")
    asked = EncodersArguments(folder / "demonstrations", folder=folder / "own")
    assert make_data.encoders(asked) == f"verdict in {folder / 'own'}"
    make_data.encoders(replace(asked, weights=folder / "mine.safetensors"))
    assert written == [folder / "own" / "encoders.safetensors", folder / "mine.safetensors"]


def test_the_same_command_records_and_trains_nothing_again(made, folder, monkeypatch):
    def refuse(*arguments):
        raise AssertionError("recorded again")

    def make(**changes):
        paths = folder / "encoders" / "some.safetensors", folder / "demonstrations"
        return make_pretrained(*paths, folder=folder / "log", **{**ARGUMENTS, **changes})

    for name in ("demonstrate", "play"):
        monkeypatch.setattr(f"bgpo_trl.data.recording._Recorder.{name}", refuse)
    left = []  # steps of each encoder; probes measure again
    monkeypatch.setattr(
        "bgpo_trl.encoders.fitting.progress_bar", lambda _, steps, **k: left.extend(steps) or steps
    )
    play = load_demonstrations(folder / "demonstrations-play")
    assert (len(play), int((~play["train"]).sum())) == (6, 3)
    encoders, bank = make()
    assert not left
    assert encoders.identity == made[0].identity
    assert bank.embedding.equal(made[1].embedding)
    with pytest.raises(ValueError, match="holds another recording"):
        make(per_task=4)


def test_files_that_do_not_belong_together_are_refused(made, folder, tmp_path, monkeypatch):
    copy = Path(shutil.copytree(folder / "encoders", tmp_path / "copy")) / "some.safetensors"
    with monkeypatch.context() as patch:
        patch.setitem(SCENES, "nico", replace(NICO, version="another"))
        with pytest.raises(
            ValueError, match=r"is of the scene nico nico-2.*this is nico another: train some"
        ):
            load_pretrained(copy)
    replace(made[1], scene="nico mars-1").save(copy.with_name("some_bank.safetensors"))
    with pytest.raises(ValueError, match=r"some_bank\.safetensors is of the scene nico mars-1"):
        load_pretrained(copy)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(5)
        other = replace(made[0], lae=SequenceAutoencoder())
    save_representation(other, copy)
    with pytest.raises(ValueError, match=r"some_bank\.safetensors was embedded by .*make it again"):
        load_pretrained(copy)
    copy.with_name("some_bank.safetensors").unlink()
    with pytest.raises(ValueError, match="no demonstration bank"):
        load_pretrained(copy)


@pytest.mark.parametrize(
    ("tasks", "name"),
    [
        (("grasp_glass",), "nico"),
        (("juggle", "grasp_glass"), "nico"),
        (nico.ALL_TASKS, "nico_eight"),
        (("juggle", "press_white"), "nico_eight"),
    ],
)
def test_tasks_outside_the_paper_use_the_encoders_of_eight_tasks(tasks, name):
    path = pretrained.default_weights(tasks)
    assert path.parts[-3:] == ("bgpo_trl", "weights", f"{name}.safetensors")
    encoders, bank = load_pretrained(tasks=tasks)
    assert encoders.identity == load_representation(path).identity
    assert {*tasks} - {"juggle"} <= {*bank.tasks}


def test_a_bank_is_used_with_the_encoders_that_embedded_it(tmp_path):
    path = tmp_path / "bank.safetensors"
    for tasks in (nico.PAPER_TASKS, nico.ALL_TASKS):
        weights = pretrained.default_weights(tasks)
        shutil.copy(pretrained.bank_path(weights), path)
        assert pretrained.weights_of_bank(path) == weights
        encoders, bank = pretrained_for(nico.PAPER_TASKS, path)
        assert encoders.identity == load_representation(weights).identity
        assert bank.tasks == nico.PAPER_TASKS
    path.write_bytes(b"rubbish")
    for unreadable in (path, tmp_path / "nothing"):
        assert pretrained.weights_of_bank(unreadable) == pretrained.default_weights()


@pytest.fixture(scope="module")
def shipped():
    return load_pretrained()


def test_a_bank_of_all_tasks_needs_none_beside_the_encoders(tmp_path):
    weights = shutil.copy(pretrained.default_weights(), tmp_path)
    bank = pretrained.bank_path(pretrained.default_weights())
    assert pretrained_for(TASKS, bank, weights=Path(weights))[1].tasks == TASKS


@pytest.mark.parametrize("tasks", [TASKS, TASKS[:0:-1]])
def test_shipped_demonstrations_are_not_copied(shipped, tmp_path, tasks):
    encoders, bank = shipped
    bank = bank.for_tasks(tasks)
    keep_inputs(tmp_path, bank, encoders)
    assert list(tmp_path.iterdir()) == []
    found = load_inputs(tmp_path, tasks, Digests(encoders.identity, bank.identity))[1]
    assert (found.tasks, found.identity) == (tasks, bank.identity)


def test_inputs_of_another_run_or_scene_are_refused(shipped, tmp_path):
    encoders, bank = shipped
    digests = Digests(encoders.identity, "0" * 64)
    with pytest.raises(ValueError, match="demonstrations 000000000000, not") as error:
        load_inputs(tmp_path / "run", TASKS, digests)
    assert str(error.value).endswith(str(tmp_path / "run" / BANK))

    foreign = replace(encoders, metadata={**encoders.metadata, "scene": "nico mars-1"})
    own_weights(tmp_path).parent.mkdir()
    save_representation(foreign, own_weights(tmp_path))
    digests = Digests(foreign.identity, bank.identity)
    with pytest.raises(ValueError, match="is of the scene nico mars-1, this is nico nico-2"):
        load_inputs(tmp_path, TASKS, digests)


def test_tasks_that_the_bank_lacks_are_taken_from_the_one_beside_the_encoders(
    bank, encoders, tmp_path
):
    """Of two tasks in the bank, one is beside the encoders under the same name."""
    one, two, three = TASKS
    weights, own = tmp_path / "encoders.safetensors", tmp_path / "own.safetensors"
    save_representation(encoders, weights)
    beside = replace(bank, encoder_id=encoders.identity)
    beside.save(pretrained.bank_path(weights))
    other = replace(beside, embedding=bank.embedding + 1).for_tasks([one, two])
    replace(other, tasks=("juggle", two)).save(own)

    found = pretrained_for(["juggle", two, three], own, weights=weights)[1]
    assert found.tasks == ("juggle", two, three)
    for task, (name, offset) in enumerate([(one, 1), (two, 1), (three, 0)]):
        expected = bank.for_tasks([name])
        assert found.of_task(task).embedding.equal(expected.embedding + offset)
        assert found.of_task(task).train.equal(expected.train)
    alone = pretrained_for([two], weights=weights)[1]
    assert alone.embedding.equal(bank.for_tasks([two]).embedding)
