"""Experiments that are small enough to run in a second, and runs of scripted policies."""

import shutil
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import pytest
import torch
from tensordict.nn import TensorDictModule

from bgpo_trl.algorithms import ALGORITHMS
from bgpo_trl.algorithms.algorithm import Policy
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.encoders import pretrained
from bgpo_trl.experiments import measure, settings
from bgpo_trl.experiments import run as experiment
from bgpo_trl.policy import LoadedRun
from suites import nico
from suites.nico.base import STATE_CENTER, STATE_SCALE
from tests.helpers import finish


@pytest.fixture
def tiny(monkeypatch, encoders, bank, make_config):
    """Untrained encoders, runs of a second and two final test episodes of each task."""
    config = make_config(episodes=6)
    for module in (experiment, pretrained):
        monkeypatch.setattr(module, "load_pretrained", lambda *_, **__: (encoders, bank))
    monkeypatch.setattr(settings, "PRESETS", {"quick": config, "desk": config})
    for name, entry in ALGORITHMS.items():
        small = replace(entry, config=make_config(name=name).algorithm)
        monkeypatch.setitem(ALGORITHMS, name, small)
    chance = torch.tensor([0.1, 0.2, 0.3, 0.4])
    monkeypatch.setattr(measure, "evaluate_random_policy", lambda tasks, **_: chance[: len(tasks)])
    test = measure._final_tests
    monkeypatch.setattr(measure, "_final_tests", lambda *run, episodes: test(*run, episodes=2))


@pytest.fixture
def tiniest(tiny, monkeypatch):
    """As `tiny`, with empty files in place of figures."""

    def touch(figure, path):
        path.parent.mkdir(exist_ok=True)
        path.touch()

    monkeypatch.setattr(measure, "save_figure", touch)
    for name in dir(measure):
        if name.startswith("plot_"):
            monkeypatch.setattr(measure, name, lambda *data, **options: None)


@pytest.fixture
def undrawn(tiny, monkeypatch):
    """As `tiny`, without figures."""

    def draw(trainer, bank, out, random_success):
        (out / "figures").mkdir(exist_ok=True)
        return []

    monkeypatch.setattr(experiment, "draw", draw)


@pytest.fixture(scope="session")
def finished_runs(begin, make_config, tmp_path_factory):
    """Trains an algorithm once, and returns the run directory."""

    @cache
    def finished(name):
        directory = tmp_path_factory.mktemp(name)
        finish(begin(directory, make_config(name=name)))
        return directory

    return finished


@pytest.fixture
def shipped(encoders, monkeypatch):
    """Untrained encoders in place of those that come with the package."""
    place = "bgpo_trl.runs.demonstrations.load_representation"
    monkeypatch.setattr(place, lambda path: encoders)


@pytest.fixture
def run_of(finished_runs, shipped, tmp_path):
    """Returns a copy of a finished run of an algorithm."""
    return lambda name: shutil.copytree(finished_runs(name), tmp_path / "runs" / name)


def scripted(act):
    """An algorithm that has only a policy, a function of the ground truth."""
    center, scale = torch.tensor(STATE_CENTER), torch.tensor(STATE_SCALE)
    actor = TensorDictModule(lambda state: act(state * scale + center), ["state"], ["action"])
    policy = Policy(actor, "state", {})
    return SimpleNamespace(device=torch.device("cpu"), snapshot=lambda *_: policy)


@pytest.fixture
def scripted_run(make_config):
    """Makes a run of two seeds on one task, played by a function from ground truth to actions."""

    def make(name, task, act):
        nico.add_task(name, task)
        config = make_config("state", "oracle", tasks=(name,), task_starts=(0,))
        none_seen = torch.zeros(4, dtype=torch.bool)
        held_out = DemonstrationBank(torch.zeros(4, 32), torch.zeros(4).long(), none_seen, (name,))
        return LoadedRun(config, scripted(act), None, held_out, [0])

    return make
