"""Policies and Q-functions against plain ones, and each seed of a stack against that seed alone."""

import itertools
import math

import pytest
import torch
from tensordict import TensorDict
from torch.func import functional_call

from bgpo_trl.modules.actor_critic import Actor, Critic
from bgpo_trl.modules.multi_head_actor import MultiHeadActor
from bgpo_trl.modules.stacked_mlp import StackedLinear, StackedMLP


def generators(n: int) -> list[torch.Generator]:
    return [torch.Generator().manual_seed(seed) for seed in range(n)]


@pytest.mark.parametrize("batch_size", [(), (2, 3)])
@pytest.mark.parametrize("batch", [(), (5, 7)])
@pytest.mark.parametrize("out_features", [1, 5, 32])  # sizes with different kernels
def test_stacked_layer_applies_each_matrix_to_its_own_slice(batch_size, batch, out_features):
    layer = StackedLinear(3, out_features, batch_size)
    x = torch.randn(*batch_size, *batch, 3, requires_grad=True)
    y = layer(x)
    assert y.shape == (*batch_size, *batch, out_features)
    indices = itertools.product(*map(range, batch_size))
    reference = torch.stack([x[i] @ layer.weight[i] + layer.bias[i] for i in indices]).view(y.shape)
    torch.testing.assert_close(y, reference)
    with torch.no_grad():
        torch.testing.assert_close(layer(x), reference)
    wrt, upstream = (x, layer.weight, layer.bias), torch.randn(y.shape)
    ours, plain = (torch.autograd.grad(value, wrt, upstream) for value in (y, reference))
    torch.testing.assert_close(ours, plain, rtol=1e-4, atol=1e-4)


def test_initial_weights_are_those_of_each_generator_alone():
    stacked = StackedMLP(6, 2, hidden_sizes=(8, 4), batch_size=(3,), generator=generators(3))
    for i, generator in enumerate(generators(3)):
        alone = StackedMLP(6, 2, hidden_sizes=(8, 4), generator=generator)
        for mine, theirs in zip(stacked.parameters(), alone.parameters(), strict=True):
            assert torch.equal(mine[i], theirs)
    with pytest.raises(ValueError, match="a sequence of 3, one each"):
        StackedLinear(2, 2, (3,), generators(2))


def test_initial_weights_are_uniform_within_one_over_root_of_inputs():
    layer = StackedLinear(100, 300, (3,), torch.Generator().manual_seed(0))
    for values in (layer.weight, layer.bias):
        assert values.abs().max() <= 0.1
        assert values.std().item() == pytest.approx(0.1 / math.sqrt(3), rel=0.05)
        assert values.mean().item() == pytest.approx(0, abs=0.01)
    assert not torch.equal(layer.weight[0], layer.weight[1])


def test_actor_and_critic_are_the_networks_of_the_paper():
    actor, critic = Actor(96, hidden_sizes=(64,)), Critic(96, hidden_sizes=(64,))
    assert [tuple(w.shape) for w in actor.parameters()] == [(96, 64), (64,), (64, 4), (4,)]
    assert [tuple(w.shape) for w in critic.parameters()] == [(100, 64), (64,), (64, 1), (1,)]
    latent, behavior = torch.randn(5, 64), torch.randn(5, 32)
    data = critic(actor(TensorDict({"latent": latent, "behavior": behavior}, [5])))

    def plain(x, network):
        w1, b1, w2, b2 = network.parameters()
        return (x @ w1 + b1).clamp(min=0) @ w2 + b2

    pre_tanh = plain(torch.cat([latent, behavior], -1), actor)
    torch.testing.assert_close(data["pre_tanh_action"], pre_tanh)
    torch.testing.assert_close(data["action"], pre_tanh.tanh())
    value = plain(torch.cat([latent, behavior, pre_tanh.tanh()], -1), critic)
    torch.testing.assert_close(data["state_action_value"], value)


def test_layer_norm_is_the_textbook_one_before_each_relu():
    mlp = StackedMLP(5, 2, hidden_sizes=(16, 8), layer_norm=True, batch_size=(3,))
    x = torch.randn(3, 7, 5)
    output = mlp(x)
    for layer in mlp.layers[:-1]:
        x = x @ layer.weight + layer.bias.unsqueeze(1)
        mean = x.mean(-1, keepdim=True)
        variance = (x - mean).square().mean(-1, keepdim=True)
        x = ((x - mean) / (variance + 1e-5).sqrt()).clamp(min=0)
    last = mlp.layers[-1]
    torch.testing.assert_close(output, x @ last.weight + last.bias.unsqueeze(1))


@pytest.mark.parametrize("stack", [(), (3,), (2, 5)])
@pytest.mark.parametrize("network", [Actor, Critic, MultiHeadActor])
def test_a_network_can_be_called_with_the_weights_of_any_stack(network, stack):
    """Weights of one seed, of other seeds than its own, and of seeds with several tasks each."""

    def make(batch_size):
        made = network(3, 2, in_keys=["state"], hidden_sizes=(8,), batch_size=batch_size)
        if network is MultiHeadActor:
            made.add_head()
        return made

    other = make(stack)
    data = TensorDict({"state": torch.randn(*stack, 1, 7, 3)}, [*stack, 1, 7])
    data["action"] = torch.randn(*stack, 1, 7, 2)
    expected, called = other(data.clone()), data.clone()
    functional_call(make((4,)), dict(other.named_parameters()), (called,))
    assert other.batch_size == stack
    for key in other.out_keys:
        assert called[key].equal(expected[key])


# ---- the policy with a head for each task


def multi_head(n_heads, hidden_sizes=(64,)):
    actor = MultiHeadActor(5, 2, in_keys=["state"], hidden_sizes=hidden_sizes)
    for _ in range(n_heads):
        actor.add_head()
    return actor


@pytest.mark.parametrize("hidden_sizes", [(8,), (16, 12, 8)])
def test_a_head_maps_the_output_of_the_trunk_to_mean_and_deviation(hidden_sizes):
    actor = multi_head(3, hidden_sizes)
    assert [layer.out_features for layer in actor.trunk.layers] == list(hidden_sizes)
    data = actor(TensorDict({"state": torch.randn(3, 7, 5)}, [3, 7]))
    for task, head in enumerate(actor.heads):
        x = data["state"][task]
        for layer in actor.trunk.layers:
            x = (x @ layer.weight + layer.bias).relu()
        loc, scale = (x @ head.weight + head.bias).split(2, -1)
        torch.testing.assert_close(data["loc"][task], loc.tanh())
        # Log-scales are spread evenly between those of the narrowest and of the widest.
        torch.testing.assert_close(data["scale"][task].log10(), scale.sigmoid() - 1)
    assert data["action"].equal(data["loc"])


def test_a_new_head_changes_neither_the_others_nor_the_trunk():
    actor = multi_head(2)
    kept = {key: value.clone() for key, value in actor.state_dict().items()}
    parameters = [id(p) for p in actor.parameters()]
    head = actor.add_head(torch.Generator().manual_seed(7))
    assert actor.heads[2] is head
    assert [id(p) for p in actor.parameters()][: len(parameters)] == parameters
    assert len(list(actor.parameters())) == len(parameters) + 2
    for key, value in kept.items():
        assert actor.state_dict()[key].equal(value)
    again = multi_head(0).add_head(torch.Generator().manual_seed(7))
    assert again.weight.equal(head.weight)
