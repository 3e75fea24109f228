"""The policy with one head per task against plain heads, and each seed of a stack alone."""

import pytest
import torch
from tensordict import TensorDict

from bgpo_trl.modules.actor_critic import MultiHeadActor


def generator(seed):
    return torch.Generator().manual_seed(seed)


def make(n_heads, seed=0, **arguments):
    arguments = {"in_keys": ["state"], "hidden_sizes": (64,), **arguments}
    actor = MultiHeadActor(5, 2, generator=generator(seed), **arguments)
    for head in range(n_heads):
        actor.add_head(generator(100 * seed + head))
    return actor


def states(*shape, scale=1.0):
    return TensorDict({"state": scale * torch.randn(*shape, 5, generator=generator(9))}, shape)


@pytest.mark.parametrize("hidden_sizes", [(8,), (16, 8), (16, 12, 8)])
def test_a_head_maps_the_output_of_the_trunk_to_mean_and_deviation(hidden_sizes):
    actor = make(3, hidden_sizes=hidden_sizes)
    assert [layer.out_features for layer in actor.trunk.layers] == list(hidden_sizes)
    data = actor(states(3, 7))
    for task, head in enumerate(actor.heads):
        x = data["state"][task]
        for layer in actor.trunk.layers:
            x = (x @ layer.weight + layer.bias).relu()
        loc, scale = (x @ head.weight + head.bias).split(2, -1)
        torch.testing.assert_close(data["loc"][task], loc.tanh())
        # Log-scales are spread evenly between those of the narrowest and of the widest.
        torch.testing.assert_close(data["scale"][task].log10(), scale.sigmoid() - 1)
    assert data["action"].equal(data["loc"])
    for key in actor.out_keys:
        assert data[key].shape == (3, 7, 2)


@pytest.mark.parametrize("scale", [1.0, 1e4])
def test_means_and_deviations_stay_within_their_bounds(scale):
    data = make(2)(states(2, 500, scale=scale))
    assert data["loc"].abs().max() <= 1
    assert data["scale"].min() >= 0.1 - 1e-6
    assert data["scale"].max() <= 1 + 1e-6
    if scale > 1:  # and reach them
        assert data["loc"].min() == -1
        assert data["loc"].max() == 1
        assert data["scale"].min() < 0.11
        assert data["scale"].max() > 0.99


def test_a_new_head_changes_neither_the_others_nor_the_trunk():
    actor = make(2)
    state = states(3, 7)
    kept = {key: value.clone() for key, value in actor.state_dict().items()}
    parameters = [id(p) for p in actor.parameters()]
    before = actor(state[:2].clone())
    head = actor.add_head(generator(7))

    assert actor.heads[2] is head
    assert [id(p) for p in actor.parameters()][: len(parameters)] == parameters
    assert len(list(actor.parameters())) == len(parameters) + 2
    for key, value in kept.items():
        assert actor.state_dict()[key].equal(value)
    after = actor(state.clone())
    for key in actor.out_keys:
        assert after[key][:2].equal(before[key])
        assert not after[key][2].equal(after[key][1])


def test_a_head_has_the_weights_of_its_generator_and_the_dtype_of_the_trunk():
    first, second = make(0, seed=1), make(0, seed=2)
    for key, value in first.add_head(generator(7)).state_dict().items():
        assert value.equal(second.add_head(generator(7)).state_dict()[key])
        assert not value.equal(first.add_head(generator(8)).state_dict()[key])
    assert make(0).double().add_head().weight.dtype == torch.float64


def test_heads_learn_from_their_own_task_only_and_the_trunk_from_all():
    actor = make(3)
    actor(states(3, 7))["loc"][1].sum().backward()
    for task, head in enumerate(actor.heads):
        assert bool(head.weight.grad.any()) == bool(head.bias.grad.any()) == (task == 1)
    assert all(p.grad.any() for p in actor.trunk.parameters())


@pytest.mark.parametrize("batch", [(), (7,), (2, 7)])
def test_stacked_policies_are_each_one_alone(batch):
    seeds = (3, 8)
    stacked = MultiHeadActor(
        *(5, 2),
        in_keys=["state"],
        hidden_sizes=(16, 8),
        batch_size=[2],
        generator=[generator(s) for s in seeds],
    )
    for head in range(3):
        stacked.add_head([generator(100 * s + head) for s in seeds])
    data = stacked(states(2, 3, *batch))
    for index, seed in enumerate(seeds):
        alone = make(3, seed=seed, hidden_sizes=(16, 8))
        for key, value in alone.state_dict().items():
            assert stacked.state_dict()[key][index].equal(value)
        expected = alone(states(2, 3, *batch)[index])
        for key in alone.out_keys:
            torch.testing.assert_close(data[key][index], expected[key])


@pytest.mark.parametrize(("n_heads", "n_tasks"), [(2, 3), (3, 2), (0, 1)])
@pytest.mark.parametrize("stack", [[], [2]])
def test_states_of_another_number_of_tasks_are_refused(stack, n_heads, n_tasks):
    actor = MultiHeadActor(5, 2, in_keys=["state"], batch_size=stack)
    for _ in range(n_heads):
        actor.add_head()
    with pytest.raises(ValueError, match=f"states of {n_tasks} tasks for {n_heads} heads"):
        actor(states(*stack, n_tasks, 7))


def test_a_policy_without_a_hidden_layer_is_refused():
    with pytest.raises(ValueError, match="at least one layer"):
        MultiHeadActor(5, hidden_sizes=())
