"""The example of an own RL algorithm: it runs, and it is what it says."""

import csv
import runpy
from collections import Counter
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from bgpo_trl.algorithms.rl import RL, LearnerSpec, make_learner
from bgpo_trl.seeding import generators

EXAMPLE = Path(__file__).parents[2] / "examples" / "own_rl_algorithm.py"


@pytest.fixture
def registry(monkeypatch):
    """Remove the entries of the example after the test."""
    monkeypatch.setitem(RL, "td3-epsilon", None)
    return RL


def test_it_runs_and_is_short(registry, capsys):
    runpy.run_path(str(EXAMPLE), run_name="__main__")
    tests = list(csv.DictReader(capsys.readouterr().out.splitlines()))
    played = [(row["algorithm"], row["seed"], row["episode"]) for row in tests if row["seed"]]
    # Every task is tested.
    assert Counter(played) == {("oracle", seed, n): 3 for n in "24" for seed in "01"}
    assert len(EXAMPLE.read_text().splitlines()) < 60


def test_it_acts_at_random_now_and_then(registry):
    config = runpy.run_path(str(EXAMPLE))["EpsilonConfig"](noise=0.0, epsilon=0.5)
    spec = LearnerSpec([4], ["state"], 3, (0.0, 1.0), torch.device("cpu"))
    learner = make_learner(config, spec)
    data, sources = TensorDict({"state": torch.randn(1, 3)}, [1]), generators([4], "exploration")
    with torch.no_grad():
        usual = learner.actor(data.unsqueeze(1))["action"].squeeze(1)
        expert = torch.tensor([0])
        drawn = torch.cat([learner.act(data, sources, expert) for _ in range(400)])
    random = drawn[(drawn != usual).any(-1)]
    assert 150 < len(random) < 250
    assert random.abs().max() > 0.9 > abs(random.mean()) * 10
