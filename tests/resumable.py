"""Runs that `test_resume` starts in separate processes and kills; imports only what they need."""

from dataclasses import replace
from functools import partial

import pytest
import torch

from bgpo_trl.data.recording import record_demonstrations
from bgpo_trl.encoders import probes
from bgpo_trl.encoders.train import train_encoders
from bgpo_trl.scenes import SCENES
from bgpo_trl.scenes.nico import NICO
from bgpo_trl.training import Trainer
from tests.conftest import EASY
from tests.helpers import TINY_ENCODERS, finish

RECORDING = {"per_task": 2, "held_out_per_task": 1}
LONGER = {
    name: replace(getattr(TINY_ENCODERS, name), steps=20) for name in ("vae", "lae", "inverse")
}
ENCODERS = replace(TINY_ENCODERS, **LONGER, checkpoint_every=3, log_every=1)


def play(directory, parts):
    """Begin or continue a run, in a process of its own."""
    torch.set_num_threads(1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(SCENES, "nico", EASY)
        config, bank, encoders = torch.load(parts, weights_only=False)
        parts = {"bank": bank, "encoders": encoders, "resume": True, "progress": False}
        finish(Trainer(config, directory, **parts))


def train_small_encoders(directory):
    """Begin or continue the training of encoders, in a process of its own."""
    torch.set_num_threads(1)
    options = {"scene": NICO, "progress": False}
    dataset = record_demonstrations(directory / "demonstrations", **RECORDING, **options)
    weights = directory / "encoders.safetensors"
    with pytest.MonkeyPatch.context() as patch:
        short = partial(probes.perceptron_predict, steps=50)
        patch.setattr(probes, "perceptron_predict", short)
        tasks = NICO.default_tasks
        train_encoders(dataset, None, weights, directory / "log", ENCODERS, tasks=tasks, **options)
