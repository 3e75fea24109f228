"""Benchmarks made small enough to be run in a second."""

from dataclasses import replace
from functools import partial

import experiment
import pytest
import torch

from benchmarks import ladder
from bgpo_trl.algorithms import ALGORITHMS


@pytest.fixture
def tiny(monkeypatch, encoders, bank, make_config):
    """The benchmarks with untrained encoders, and runs of a second."""
    config = make_config(episodes=6)
    for module in (experiment, ladder):
        monkeypatch.setattr(module, "load_pretrained", lambda: (encoders, bank))
        monkeypatch.setattr(module, "PRESETS", {"quick": config, "desk": config})
    for name, entry in ALGORITHMS.items():
        small = replace(entry, config=make_config(name=name).algorithm)
        monkeypatch.setitem(ALGORITHMS, name, small)
    for rung, (name, bgpo, compose) in ladder.RUNGS.items():
        small = replace(bgpo, max_steps=6)
        monkeypatch.setitem(ladder.RUNGS, rung, (name, small, compose))
    chance = torch.tensor([0.1, 0.2, 0.3])
    monkeypatch.setattr(experiment, "evaluate_random_policy", lambda **kwargs: chance)


@pytest.fixture
def tiniest(tiny, monkeypatch):
    """Of what comes after training, less: few test episodes, and figures that are not drawn."""

    def touch(figure, path):
        path.parent.mkdir(exist_ok=True)
        path.touch()

    monkeypatch.setattr(experiment, "measure", partial(experiment.measure, episodes=2))
    monkeypatch.setattr(experiment, "save_figure", touch)
