"""Benchmarks made small enough to be run in a second."""

import shutil
from dataclasses import replace

import pytest
import torch

from benchmarks import ladder
from bgpo_trl.algorithms import ABLATIONS, ALGORITHMS
from bgpo_trl.experiments import arguments, measure
from bgpo_trl.experiments import run as experiment
from bgpo_trl.figures import of_run as growth
from bgpo_trl.training import Trainer


@pytest.fixture
def tiny(monkeypatch, encoders, bank, make_config):
    """The benchmarks with untrained encoders, runs of a second and two test episodes after it."""
    config = make_config(episodes=6)
    for module in (experiment, ladder):
        monkeypatch.setattr(module, "load_pretrained", lambda *_, **__: (encoders, bank))
    for module in (arguments, ladder):
        monkeypatch.setattr(module, "PRESETS", {"quick": config, "desk": config})
    for name, entry in ALGORITHMS.items():
        small = replace(entry, config=make_config(name=name).algorithm)
        monkeypatch.setitem(ALGORITHMS, name, small)
    for rung, (name, bgpo) in ladder.RUNGS.items():
        monkeypatch.setitem(ladder.RUNGS, rung, (name, replace(bgpo, max_steps=6)))
    for name, entry in ABLATIONS.items():
        small = replace(entry, config=replace(entry.config, max_steps=6))
        monkeypatch.setitem(ABLATIONS, name, small)
    chance = torch.tensor([0.1, 0.2, 0.3])
    limit = config.algorithm.max_steps

    def of_random_policy(*, tasks, episodes, max_steps, spread):
        assert (max_steps, spread) == (limit, config.spread)
        return chance

    monkeypatch.setattr(measure, "evaluate_random_policy", of_random_policy)
    test = measure._final_tests
    monkeypatch.setattr(measure, "_final_tests", lambda *run, episodes: test(*run, episodes=2))


@pytest.fixture
def tiniest(tiny, monkeypatch):
    """Of what comes after training, less: figures that are not drawn."""

    def touch(figure, path):
        path.parent.mkdir(exist_ok=True)
        path.touch()

    for module in (measure, growth):
        monkeypatch.setattr(module, "save_figure", touch)
        for name in dir(module):
            if name.startswith("plot_"):
                monkeypatch.setattr(module, name, lambda *data, **options: None)


@pytest.fixture
def undrawn(tiny, monkeypatch):
    """Nothing is drawn after training, and nothing said of it."""

    def draw(trainer, bank, out, random_success):
        (out / "figures").mkdir(exist_ok=True)
        return []

    monkeypatch.setattr(experiment, "draw", draw)


@pytest.fixture(scope="session")
def finished_runs(bank, encoders, make_config, tmp_path_factory):
    """Plays a run of an algorithm or a variant to its end, once."""
    directories = {}

    def finished(name):
        if name not in directories:
            directories[name] = tmp_path_factory.mktemp(name)
            config = make_config(name=name)
            parts = {"bank": bank, "encoders": encoders, "progress": False}
            with Trainer(config, directories[name], **parts) as trainer:
                trainer.run()
        return directories[name]

    return finished


@pytest.fixture
def run_of(finished_runs, encoders, monkeypatch, tmp_path):
    """Returns a copy of a finished run, whose encoders are taken for those of the package."""
    place = "bgpo_trl.runs.demonstrations.load_representation"
    monkeypatch.setattr(place, lambda path, scene_version: encoders)
    return lambda name: shutil.copytree(finished_runs(name), tmp_path / "runs" / name)
