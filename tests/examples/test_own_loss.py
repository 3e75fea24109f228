"""The example of an own loss: it runs, and its gradients are those of its equation."""

import csv
import runpy
from collections import Counter
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from bgpo_trl.algorithms.rl import RL, LearnerSpec, make_learner

EXAMPLE = Path(__file__).parents[2] / "examples" / "own_loss.py"


@pytest.fixture
def registry(monkeypatch):
    """Remove the entries of the example after the test."""
    monkeypatch.setitem(RL, "awac", None)
    return RL


def test_it_runs_and_every_task_is_tested(registry, capsys):
    runpy.run_path(str(EXAMPLE), run_name="__main__")
    tests = list(csv.DictReader(capsys.readouterr().out.splitlines()))
    played = [(row["algorithm"], row["seed"], row["episode"]) for row in tests if row["seed"]]
    assert Counter(played) == {("oracle", "0", n): 3 for n in "24"}


def test_the_actor_imitates_good_actions_most(registry):
    config = runpy.run_path(str(EXAMPLE))["AWACConfig"](hidden_sizes=(8,))
    spec = LearnerSpec([4, 7], ["state"], 3, (0.0, 1.0), torch.device("cpu"))
    learner = make_learner(config, spec)
    generator = torch.Generator().manual_seed(0)
    state, following = torch.randn(2, 2, 1, 16, 3, generator=generator).unbind(0)
    action = torch.rand(2, 1, 16, 4, generator=generator) * 2 - 1
    flag = torch.rand(2, 1, 16, 1, generator=generator) < 0.3
    successor = {"state": following, "reward": flag.float(), "terminated": flag}
    batch = TensorDict({"state": state, "action": action, "next": successor}, [2, 1, 16])
    losses = learner.loss(batch.clone())

    acted = learner.loss.call_network("actor_network", batch.select("state"))
    q = [
        learner.loss.values("value_network", data)
        for data in (batch.select("state", "action"), acted.clone())
    ]
    weight = ((q[0] - q[1]) / 0.1).exp().clamp(max=20).detach()
    assert weight.std() > 0
    expected = (weight * (acted["action"] - action).square().mean(-1)).mean(-1)
    torch.testing.assert_close(losses["loss_actor"], expected)
    losses["loss_actor"].sum().backward()
    assert all(p.grad.any() for p in learner.loss.actor_network_params.parameters())
    assert all(p.grad is None for p in learner.loss.value_network_params.parameters())

    policy = [p.clone() for p in learner.actor.parameters()]
    learner.learn(batch)
    assert not any(p.equal(q) for p, q in zip(policy, learner.actor.parameters(), strict=True))
