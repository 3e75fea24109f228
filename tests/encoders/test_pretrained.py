"""Encoders and the bank of their embeddings, which are made and loaded together."""

import json
import shutil
from dataclasses import replace

import pytest
import torch

from bgpo_trl.configs import (
    InverseModelConfig,
    RepresentationConfig,
    SequenceAutoencoderConfig,
    VAEConfig,
)
from bgpo_trl.data.dataset import load_demonstrations
from bgpo_trl.encoders.pretrained import load_pretrained
from bgpo_trl.encoders.representation import save_representation
from bgpo_trl.encoders.train import make_pretrained
from bgpo_trl.modules.sequence_autoencoder import SequenceAutoencoder
from bgpo_trl.scenes import SCENES
from bgpo_trl.scenes.nico import NICO
from suites import nico

TINY = RepresentationConfig(
    vae=VAEConfig(steps=2, batch_size=4, warmup_steps=1),
    lae=SequenceAutoencoderConfig(steps=2, batch_size=4, warmup_steps=1),
    inverse=InverseModelConfig(hidden_size=8, batch_size=8, steps=4, warmup_steps=1),
)
TASKS = nico.PAPER_TASKS[::-1]
ARGUMENTS = {
    "config": TINY,
    "tasks": TASKS,
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


@pytest.fixture
def copy(made, folder, tmp_path):
    """A copy of the files, which a test may change."""
    shutil.copytree(folder / "encoders", tmp_path, dirs_exist_ok=True)
    return tmp_path / "some.safetensors"


def test_made_encoders_and_bank_are_loaded(made, folder):
    encoders, bank = made
    loaded_encoders, loaded_bank = load_pretrained(folder / "encoders" / "some.safetensors")
    assert loaded_encoders.identity == encoders.identity
    assert loaded_encoders.metadata["command"] == "a command"
    assert loaded_bank.tasks == bank.tasks == TASKS
    for recorded in ("demonstrations", "demonstrations-play"):
        assert json.loads((folder / recorded / "dataset.json").read_text())["tasks"] == [*TASKS]
    for name in ("embedding", "task", "train"):
        assert getattr(loaded_bank, name).equal(getattr(bank, name))


def test_the_bank_holds_the_embedding_of_each_demonstration(made, folder):
    encoders, bank = made
    demonstrations = load_demonstrations(folder / "demonstrations")
    assert bank.task.tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2]
    assert bank.train.tolist() == [True, True, False] * 3
    for row, demonstration in enumerate(demonstrations):
        length = int(demonstration["length"])
        latent = encoders.vae.latent(demonstration["pixels"][:length])
        phi = encoders.lae.encode(latent[None], torch.tensor([length]))[0]
        torch.testing.assert_close(bank.embedding[row], phi, rtol=1e-4, atol=1e-5)
    assert len(bank.embedding.unique(dim=0)) == 9


def test_the_same_command_records_and_trains_nothing_again(made, folder, monkeypatch):
    def refuse(*arguments):
        raise AssertionError("recorded again")

    for name in ("demonstrate", "play"):
        monkeypatch.setattr(f"bgpo_trl.data.recording._Recorder.{name}", refuse)
    play = load_demonstrations(folder / "demonstrations-play")
    assert (len(play), int((~play["train"]).sum())) == (6, 3)
    encoders, bank = make_pretrained(
        folder / "encoders" / "some.safetensors",
        folder / "demonstrations",
        folder=folder / "log",
        **ARGUMENTS,
    )
    assert encoders.identity == made[0].identity
    assert bank.embedding.equal(made[1].embedding)
    with pytest.raises(ValueError, match="holds another recording"):
        make_pretrained(
            folder / "encoders" / "some.safetensors",
            folder / "demonstrations",
            folder=folder / "log",
            **{**ARGUMENTS, "per_task": 4},
        )


def test_files_that_do_not_belong_together_are_refused(made, copy, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setitem(SCENES, "nico", replace(NICO, version="another"))
        with pytest.raises(ValueError, match="scene another"):
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
