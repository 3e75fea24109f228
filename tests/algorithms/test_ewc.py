"""Elastic weight consolidation: Fisher information and penalty against plain computations."""

import pytest
import torch
from tensordict import TensorDict
from torch.func import functional_call

from bgpo_trl.algorithms.ewc import EWCLearner, diagonal_fisher
from bgpo_trl.algorithms.rl import LearnerSpec, make_learner
from bgpo_trl.configs import RLConfig
from bgpo_trl.modules.actor_critic import Actor
from tests.algorithms.playing import make_batch

N_STATE = 6


def make(weight=1.0, seeds=(3, 8), proposals="actor"):
    spec = LearnerSpec(seeds, ["state"], N_STATE, (0.0, 1.0), torch.device("cpu"))
    config = RLConfig(hidden_sizes=(16,), critics=2, proposals=proposals)
    return EWCLearner(make_learner(config, spec), weight=weight)


def weights_of(learner, policy):
    """Return the weights ``[S, 1, ...]`` of actors or clones, by name in the network."""
    return dict(getattr(learner.loss, f"{policy}_network_params").flatten_keys(".").items())


def moved_at_random(learner, policy):
    """Move the weights of all actors or clones; return by how much seed 1 has moved."""
    source, moved = torch.Generator().manual_seed(4), {}
    for key, value in weights_of(learner, policy).items():
        step = torch.randn(value.shape, generator=source)
        with torch.no_grad():
            value.add_(step)
        moved[key] = step[1, 0]
    return moved


def test_the_fisher_information_is_that_of_a_plain_loop():
    actor = Actor(5, 3, in_keys=["latent", "context"], hidden_sizes=(4,), batch_size=(2, 1))
    weights = {key: value[1, 0].detach() for key, value in actor.named_parameters()}
    inputs = TensorDict({"latent": torch.randn(70, 3), "context": torch.randn(70, 2)}, [70])
    plain = {key: value.clone().requires_grad_() for key, value in weights.items()}
    expected = {key: torch.zeros_like(value) for key, value in weights.items()}
    for sample in inputs:
        for component in functional_call(actor, plain, (sample.clone(),))["action"]:
            gradients = torch.autograd.grad(component, [*plain.values()], retain_graph=True)
            for key, gradient in zip(expected, gradients, strict=True):
                expected[key] += gradient**2 / 70
    torch.testing.assert_close(diagonal_fisher(actor, weights, inputs), expected)
    assert set(inputs.keys()) == {"latent", "context"}


@pytest.mark.parametrize(("proposals", "policies"), [("actor", 1), ("both", 2)])
def test_the_penalty_is_that_of_equation_3_for_each_seed(proposals, policies):
    learner, inputs = make(5.0, proposals=proposals), make_batch(30).select("state")
    assert not learner.penalty().any()
    learner.consolidate(1, inputs)
    assert not learner.penalty().any()
    expected, gradients = torch.tensor(0.0), {}
    for policy in ("actor", "clone")[:policies]:
        network = getattr(learner.loss, f"{policy}_network")
        weights = {key: v[1, 0].detach() for key, v in weights_of(learner, policy).items()}
        fisher = diagonal_fisher(network, weights, inputs)
        moved = moved_at_random(learner, policy)
        expected = expected + 5 / 2 * sum((fisher[key] * moved[key] ** 2).sum() for key in fisher)
        gradients[policy] = {key: 5 * fisher[key] * moved[key] for key in fisher}
    penalty = learner.penalty()
    torch.testing.assert_close(penalty.detach(), torch.stack([0 * expected, expected]).view(2, 1))
    learner.optimizer.zero_grad()
    penalty.sum().backward()
    for policy, of_policy in gradients.items():
        for key, value in weights_of(learner, policy).items():
            assert value.grad is not None
            torch.testing.assert_close(value.grad[1, 0], of_policy[key], rtol=1e-4, atol=1e-6)
            assert not value.grad[0].any()
    assert all(p.grad is None for p in learner.loss.value_network_params.values(True, True))


def test_a_second_boundary_adds_its_information_and_moves_the_anchor():
    learner, inputs = make(), make_batch(30).select("state")
    learner.consolidate(0, inputs)
    first = {key: value.clone() for key, value in learner.fisher.items()}
    for seed in range(5):
        learner.learn(make_batch(2, 1, 32, seed=seed))
    assert learner.penalty()[0] > 0
    weights = {key: v.detach().clone() for key, v in weights_of(learner, "actor").items()}
    learner.consolidate(0, inputs)
    assert not learner.penalty().any()
    second = diagonal_fisher(learner.policy, {k: v[0, 0] for k, v in weights.items()}, inputs)
    for key, value in second.items():
        name = f"actor_network_params.{key}"
        torch.testing.assert_close(learner.fisher[name][0, 0], first[name][0, 0] + value)
        assert learner.anchor[name][0].equal(weights[key][0])
        assert not learner.fisher[name][1].any()
