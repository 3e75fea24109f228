"""SAC's policy against PyTorch's distributions, and each seed of a stack alone."""

import pytest
import torch
from tensordict import TensorDict
from torch.distributions import Normal, TanhTransform, TransformedDistribution

from bgpo_trl.modules.actor_critic import GaussianActor


def make(batch_size=(), generator=None):
    network = {"in_keys": ["state"], "hidden_sizes": (8,), "batch_size": batch_size}
    return GaussianActor(3, 2, generator=generator, **network)


def states(*shape, scale=1.0):
    state = torch.randn(*shape, 3, generator=torch.Generator().manual_seed(0)) * scale
    return TensorDict({"state": state}, shape)


def test_actions_are_those_of_a_squashed_gaussian():
    actor, noise = make(), torch.randn(50, 2)
    drawn = actor.sample(states(50), noise)
    pre_tanh = drawn["loc"] + drawn["scale"] * noise
    assert drawn["action"].equal(pre_tanh.tanh())
    # In double precision, since PyTorch's own inverts the tanh.
    policy = TransformedDistribution(
        Normal(drawn["loc"].double(), drawn["scale"].double()), TanhTransform()
    )
    expected = policy.log_prob(pre_tanh.double().tanh()).sum(-1).float()
    torch.testing.assert_close(drawn["action_log_prob"], expected, rtol=1e-4, atol=1e-4)


def test_without_noise_it_acts_by_the_mean():
    actor = make()
    acted = actor(states(7))
    assert acted["action"].equal(acted["loc"].tanh())
    still = actor.sample(states(7), torch.zeros(7, 2))
    assert still["action"].equal(acted["action"])


def test_log_probabilities_and_their_gradients_stay_finite_where_the_tanh_saturates():
    actor = make()
    drawn = actor.sample(states(20, scale=1e3), torch.full((20, 2), 50.0))
    assert drawn["action"].abs().max() == 1
    scale = drawn["scale"].log()
    assert (scale.min().item(), scale.max().item()) == (pytest.approx(-5), pytest.approx(2))
    drawn["action_log_prob"].sum().backward()
    assert torch.isfinite(drawn["action_log_prob"]).all()
    assert all(torch.isfinite(p.grad).all() for p in actor.parameters())


def test_gradients_reach_mean_and_scale_through_the_noise():
    actor, noise = make(), torch.randn(50, 2)
    drawn = actor.sample(states(50), noise)
    loc, scale = drawn["loc"], drawn["scale"]
    slope = 1 - drawn["action"].square()
    grads = torch.autograd.grad(drawn["action"].sum(), [loc, scale])
    torch.testing.assert_close(grads[0], slope)
    torch.testing.assert_close(grads[1], slope * noise)


@pytest.mark.parametrize("n_seeds", [1, 3])
def test_stacked_seeds_are_each_seed_alone(n_seeds):
    stacked = make([n_seeds], [torch.Generator().manual_seed(seed) for seed in range(n_seeds)])
    data, noise = states(n_seeds, 5), torch.randn(n_seeds, 5, 2)
    together = stacked.sample(data.clone(), noise)
    for seed in range(n_seeds):
        alone = make(generator=torch.Generator().manual_seed(seed))
        apart = alone.sample(data[seed].clone(), noise[seed])
        for key in ("action", "action_log_prob", "loc", "scale"):
            torch.testing.assert_close(together[key][seed], apart[key])
