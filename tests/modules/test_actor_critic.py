"""Perceptrons against plain ones, and each seed of a stack against that seed alone."""

import itertools
import math

import pytest
import torch
from tensordict import TensorDict
from torch.func import functional_call

from bgpo_trl.modules.actor_critic import Actor, Critic, GaussianActor, MultiHeadActor
from bgpo_trl.modules.stacked_mlp import StackedLinear, StackedMLP


def generators(n: int) -> list[torch.Generator]:
    return [torch.Generator().manual_seed(seed) for seed in range(n)]


@pytest.mark.parametrize("batch_size", [(), (4,), (2, 3)])
@pytest.mark.parametrize("batch", [(), (7,), (5, 7)])
@pytest.mark.parametrize("out_features", [1, 5, 32])  # sizes with different kernels
def test_stacked_layer_applies_each_matrix_to_its_own_slice(batch_size, batch, out_features):
    layer = StackedLinear(3, out_features, batch_size)
    x = torch.randn(*batch_size, *batch, 3, requires_grad=True)
    y = layer(x)
    assert y.shape == (*batch_size, *batch, out_features)
    indices = itertools.product(*map(range, batch_size))
    reference = torch.stack([x[i] @ layer.weight[i] + layer.bias[i] for i in indices]).view(y.shape)
    torch.testing.assert_close(y, reference)
    wrt = x, layer.weight, layer.bias
    upstream = torch.randn(y.shape)
    for ours, plain in zip(
        torch.autograd.grad(y, wrt, upstream),
        torch.autograd.grad(reference, wrt, upstream),
        strict=True,
    ):
        torch.testing.assert_close(ours, plain, rtol=1e-4, atol=1e-4)


def test_initial_weights_are_those_of_each_generator_alone():
    stacked = StackedMLP(6, 2, hidden_sizes=(8, 4), batch_size=(3,), generator=generators(3))
    for i, generator in enumerate(generators(3)):
        alone = StackedMLP(6, 2, hidden_sizes=(8, 4), generator=generator)
        for mine, theirs in zip(stacked.parameters(), alone.parameters(), strict=True):
            assert torch.equal(mine[i], theirs)


def test_initial_weights_are_uniform_within_one_over_root_of_inputs():
    layer = StackedLinear(100, 300, (3,), torch.Generator().manual_seed(0))
    for values in (layer.weight, layer.bias):
        assert values.abs().max() <= 0.1
        assert values.std().item() == pytest.approx(0.1 / math.sqrt(3), rel=0.05)
        assert values.mean().item() == pytest.approx(0, abs=0.01)
    assert not torch.equal(layer.weight[0], layer.weight[1])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: StackedLinear(2, 2, (3,), generators(2)), "needs 3, got 2"),
        (lambda: StackedLinear(0, 2), "at least 1"),
        (lambda: Actor(6, batch_size=0), "at least 1"),
        (lambda: StackedLinear(2, 2, (3,))(torch.zeros(5, 3, 2)), "one leading index per layer"),
        (lambda: StackedLinear(2, 2)(torch.zeros(4, 1)), "2 features"),
    ],
)
def test_bad_sizes_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


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


def test_inputs_widths_and_depths_can_be_configured():
    keys = [("observation", "state"), "task_one_hot"]
    options = {"in_keys": keys, "hidden_sizes": (16, 8), "batch_size": (3,)}
    actor, critic = Actor(9, 2, **options), Critic(9, 2, **options)
    data = TensorDict(
        {"observation": {"state": torch.randn(3, 5, 6)}, "task_one_hot": torch.randn(3, 5, 3)},
        [3, 5],
    )
    critic(actor(data))
    assert data["action"].shape == (3, 5, 2)
    assert data["state_action_value"].shape == (3, 5, 1)
    assert [p.shape[-1] for p in actor.parameters() if p.ndim == 3] == [16, 8, 2]


@pytest.mark.parametrize("stack", [(), (3,), (2, 5)])
@pytest.mark.parametrize("network", [Actor, Critic, GaussianActor, MultiHeadActor])
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


def test_networks_can_be_called_with_keywords_and_name_a_missing_entry():
    actor = Actor(3, 2, in_keys=["state"], batch_size=5)  # a number for a shape
    state = torch.randn(5, 3)
    expected = actor(TensorDict({"state": state}, [5]))
    pre_tanh, action = actor(state=state)
    assert torch.equal(action, expected["action"])
    assert torch.equal(pre_tanh, expected["pre_tanh_action"])
    with pytest.raises(ValueError, match="Actor found no 'state'"):
        actor(TensorDict({"latent": state}, [5]))
