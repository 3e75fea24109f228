"""The examples of an own loss and of an own RL algorithm: they run, and are what they say."""

import csv
import runpy
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict

from bgpo_trl.algorithms.rl import LearnerSpec
from bgpo_trl.configs import RLConfig
from bgpo_trl.seeding import generators

EXAMPLES = Path(__file__).parents[2] / "examples"


def learner_of(example, algorithm, rl, seeds):
    """The learner that an example's algorithm makes, of policies of three numbers."""
    kind = runpy.run_path(str(EXAMPLES / f"{example}.py"))[algorithm]
    spec = LearnerSpec(seeds, ["state"], 3, (0.0, 1.0), torch.device("cpu"))
    made = kind.__new__(kind)
    made.config = SimpleNamespace(rl=rl)
    return made.make_learner(spec)


@pytest.mark.parametrize(("name", "seeds"), [("own_loss", "0"), ("own_rl_algorithm", "01")])
def test_it_runs_and_every_task_is_tested(name, seeds, capsys):
    runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
    tests = list(csv.DictReader(capsys.readouterr().out.splitlines()))
    played = [(row["algorithm"], row["seed"], row["episode"]) for row in tests if row["seed"]]
    own = "awac" if name == "own_loss" else "epsilon"
    assert Counter(played) == {(own, seed, n): 3 for n in "24" for seed in seeds}


def test_the_actor_imitates_good_actions_most():
    learner = learner_of("own_loss", "AWAC", RLConfig(hidden_sizes=(8,)), [4, 7])
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

    policy = [p.clone() for p in learner.policy.parameters()]
    learner.learn(batch)
    assert not any(p.equal(q) for p, q in zip(policy, learner.policy.parameters(), strict=True))


def test_it_acts_at_random_now_and_then():
    names = runpy.run_path(str(EXAMPLES / "own_rl_algorithm.py"))
    rl = names["EpsilonRLConfig"](noise=0.0, epsilon=0.5)
    learner = learner_of("own_rl_algorithm", "EpsilonBGPO", rl, [4])
    data, sources = TensorDict({"state": torch.randn(1, 3)}, [1]), generators([4], "exploration")
    with torch.no_grad():
        usual = learner.policy(data.unsqueeze(1))["action"].squeeze(1)
        expert = torch.tensor([0])
        drawn = torch.cat([learner.act(data, sources, expert) for _ in range(400)])
    random = drawn[(drawn != usual).any(-1)]
    assert 150 < len(random) < 250
    assert random.abs().max() > 0.9 > abs(random.mean()) * 10
