"""Policies and Q-functions against plain ones, and each seed of a stack against that seed alone."""

import itertools

import pytest
import torch
from tensordict import TensorDict
from torch.func import functional_call

from bgpo_trl.modules.actor_critic import Actor, Critic
from bgpo_trl.modules.multi_head_actor import MultiHeadActor
from bgpo_trl.modules.stacked_mlp import StackedLinear


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


def multi_head(n_heads, hidden_sizes=(64,), **options):
    actor = MultiHeadActor(5, 2, in_keys=["state"], hidden_sizes=hidden_sizes, **options)
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


@pytest.mark.parametrize("layer_norm", [False, True])
def test_a_head_with_the_trunk_is_an_actor(layer_norm):
    actor = multi_head(2, (16, 12), layer_norm=layer_norm)
    state = torch.randn(2, 7, 5)
    action = actor(TensorDict({"state": state}, [2, 7]))["action"]
    one = Actor(5, 2, in_keys=["state"], hidden_sizes=(16, 12), layer_norm=layer_norm)
    for task in range(2):
        one.load_state_dict(actor.policy(task))
        expected = one(TensorDict({"state": state[task]}, [7]))["action"]
        torch.testing.assert_close(action[task], expected)


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
