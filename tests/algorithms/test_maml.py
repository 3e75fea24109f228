"""MAML as a whole: by what it acts, what it adapts to, and that seeds share nothing."""

import pytest
import torch
from torch.nn.functional import layer_norm

from bgpo_trl.seeding import generators
from bgpo_trl.transforms import TaskSchedule
from tests.algorithms.playing import play

pytestmark = pytest.mark.usefixtures("easy_world")
SEEDS = (4, 6)
SIZE, N_TASKS = 16, 3  # of the ground truth, and tasks
DEMONSTRATIONS = {"state": "latent", "name": "maml-demonstrations", "task_batch_size": 8}


@pytest.fixture
def make(make_task_algorithm):
    return lambda name="maml", **changes: make_task_algorithm(name, **changes)


def perceptron(weights, state, normalize=False):
    """The output of one network with the weights that its ``state_dict`` has."""
    first, first_bias, second, second_bias = (
        weights[f"mlp.layers.{i}.{name}"] for i in range(2) for name in ("weight", "bias")
    )
    hidden = state @ first + first_bias
    hidden = layer_norm(hidden, hidden.shape[-1:]) if normalize else hidden
    return hidden.relu() @ second + second_bias


def weights_of(parameters, *index):
    """Copies of the weights of one network of a stack, by name."""
    flat = dict(parameters.flatten_keys(".").items())
    return {key: value.detach()[index].clone() for key, value in flat.items()}


def meta_weights(algorithm, seed):
    weights = dict(algorithm.meta_actor.named_parameters())
    return {key: value.detach()[seed].clone() for key, value in weights.items()}


def by_task(data):
    """The states of each task of one seed, in the order in which they were seen."""
    return [data["state"][data["task"] == task] for task in range(N_TASKS)]


def snapshot(algorithm, index, embedding=0.0, generator_seed=0):
    shape = (algorithm.n_tasks, 2)
    task = torch.arange(algorithm.n_tasks).unsqueeze(1).expand(shape)
    generator = torch.Generator().manual_seed(generator_seed)
    return algorithm.snapshot(index, torch.full((*shape, 32), embedding), task, generator)


def test_training_episodes_are_played_by_the_policy_adapted_to_their_task_with_noise(make):
    algorithm = make()
    noise = generators(SEEDS, "exploration")
    clamped, adapted_to = [], set()

    def watch(chosen):
        for index, source in enumerate(noise):
            task = int(chosen["task"][index])
            weights = weights_of(algorithm.loss.actor_network_params, index, task)
            action = perceptron(weights, chosen["state"][index]).tanh()
            noisy = action + 0.3 * torch.randn(4, generator=source)
            torch.testing.assert_close(chosen["action"][index], noisy.clamp(-1, 1))
            clamped.append(bool((noisy.abs() > 1).any()))
            meta = perceptron(meta_weights(algorithm, index), chosen["state"][index]).tanh()
            if (meta - action).abs().max() > 1e-4:
                adapted_to.add(task)

    play(algorithm, 40, watch=watch)
    assert set(clamped) == {True, False}
    assert adapted_to == {0, 1, 2}


def test_testing_adapts_by_one_plain_step_on_transitions_of_the_task(make):
    algorithm = make(schedule=TaskSchedule((0, 2, 99)), adaptation_size=20, inner_learning_rate=0.5)
    data, _ = play(algorithm, 40)
    for index in range(2):
        frozen = snapshot(algorithm, index, generator_seed=5).parameters
        draw = torch.randint(2**63 - 1, (), generator=torch.Generator().manual_seed(5))
        stream = torch.Generator().manual_seed(int(draw))
        shares = torch.rand(2 * 20, generator=stream, dtype=torch.float64).view(2, 20)
        start = meta_weights(algorithm, index)
        seen = by_task(data[index])
        assert [len(states) >= 4 for states in seen] == [True, True, False]
        for task in (0, 1):
            states = seen[task][(shares[task] * len(seen[task])).long()]
            policy = {key: value.clone().requires_grad_() for key, value in start.items()}
            pre_tanh = perceptron(policy, states)
            critic = weights_of(algorithm.loss.value_network_params, index, task)
            value = perceptron(critic, torch.cat([states, pre_tanh.tanh()], -1), normalize=True)
            loss = 0.01 * pre_tanh.square().mean() - value.mean()
            gradients = torch.autograd.grad(loss, list(policy.values()))
            for (key, before), gradient in zip(start.items(), gradients, strict=True):
                step = -0.5 * gradient
                torch.testing.assert_close(
                    frozen[key][task] - before, step, rtol=1e-3, atol=1e-6, msg=key
                )
                assert step.abs().max() > 1e-4
        for key, before in start.items():
            assert frozen[key][2].equal(before)


def test_each_half_of_a_tasks_batch_has_its_share_of_demonstrations(make, bank):
    """One half is to adapt to, the other to judge the adapted policy by."""
    algorithm = make(**DEMONSTRATIONS)
    assert algorithm.config.demonstration_share == 0.25
    batches, learn = [], algorithm.learn
    algorithm.learn = lambda batch: (batches.append(batch.clone()), learn(batch))[1]
    data, _ = play(algorithm, 45)
    steps = bank.seen().steps
    n_batches = 0
    for batch in batches:
        assert batch.shape == (2, N_TASKS, 8)
        for seed, task in batch["priority_weight"].all(-1).nonzero().tolist():
            latents = batch["latent"][seed, task]
            played = (latents.unsqueeze(1) == data["latent"][seed]).all(-1).any(-1)
            shown = (latents.unsqueeze(1) == steps.latents(torch.arange(len(steps.latent)))).all(-1)
            is_shown = shown.any(-1)
            assert is_shown.equal(~played)
            assert is_shown.tolist() == 2 * [False, False, False, True]
            frame = shown[is_shown].long().argmax(-1)
            of = (frame.unsqueeze(-1) >= steps.first) & (
                frame.unsqueeze(-1) < steps.first + steps.length
            )
            assert (bank.seen().task[of.long().argmax(-1)] == task).all()
            n_batches += 1
    assert n_batches > 50


def test_testing_adapts_to_as_many_demonstrations_of_the_task_as_training(make, bank):
    algorithm = make(**DEMONSTRATIONS, adaptation_size=20)
    play(algorithm, 45)
    adapted_to, adapt = [], algorithm.loss.adapt
    algorithm.loss.adapt = lambda data: (adapted_to.append(data), adapt(data))[1]
    for _ in range(2):
        snapshot(algorithm, 0, generator_seed=5)
    first, second = adapted_to
    assert (first == second).all()
    assert first.shape == (2, N_TASKS, 20)
    assert first["priority_weight"].all()
    steps = bank.seen().steps
    latents = steps.latents(torch.arange(len(steps.latent)))
    is_shown = (first["latent"].unsqueeze(-2) == latents).all(-1).any(-1)
    assert is_shown.equal(first["demonstrated"])
    assert (is_shown.sum(-1) == 5).all()  # a share of .25
