"""MAML: what it adapts to, and by what it judges the adapted policies."""

import pytest
import torch

from bgpo_trl.transforms import TaskSchedule
from tests.algorithms.playing import perceptron, play, snapshot, spy_batches, weights_of

pytestmark = pytest.mark.usefixtures("easy_world")
N_TASKS = 3


def test_testing_adapts_by_one_plain_step_on_transitions_of_the_task(make_task_algorithm):
    options = {"adaptation_size": 20, "inner_learning_rate": 0.5}
    algorithm = make_task_algorithm("maml", schedule=TaskSchedule((0, 2, 99)), **options)
    data, _ = play(algorithm, 40)
    for index in range(2):
        frozen = snapshot(algorithm, index, seed=5).parameters
        draw = torch.randint(2**63 - 1, (), generator=torch.Generator().manual_seed(5))
        stream = torch.Generator().manual_seed(int(draw))
        shares = torch.rand(2 * 20, generator=stream, dtype=torch.float64).view(2, 20)
        named = algorithm.meta_actor.named_parameters()
        start = {key: value.detach()[index].clone() for key, value in named}
        seen = [data["state"][index][data["task"][index] == task] for task in range(3)]
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
                step, moved = -0.5 * gradient, frozen[key][task] - before
                torch.testing.assert_close(moved, step, rtol=1e-3, atol=1e-6, msg=key)
                assert step.abs().max() > 1e-4
        for key, before in start.items():
            assert frozen[key][2].equal(before)


def test_testing_adapts_to_the_latest_transitions_of_the_task(make_task_algorithm):
    algorithm = make_task_algorithm("maml", adaptation_size=9, adapt_to_latest=True)
    data, _ = play(algorithm, 40)
    adapted_to, adapt = [], algorithm.loss.adapt
    algorithm.loss.adapt = lambda data: (adapted_to.append(data), adapt(data))[1]
    first, second = (snapshot(algorithm, 1, seed=seed).parameters for seed in (5, 6))
    assert all(value.equal(second[key]) for key, value in first.items())
    for index in range(2):
        for task in range(N_TASKS):
            seen = data["state"][index][data["task"][index] == task][-9:]
            assert adapted_to[0]["state"][index, task, : len(seen)].equal(seen)
            assert adapted_to[0]["priority_weight"][index, task].sum().round() == 9


def test_each_half_of_a_tasks_batch_has_its_share_of_demonstrations(make_task_algorithm, bank):
    """One half is to adapt to, the other to judge the adapted policy by."""
    algorithm = make_task_algorithm("maml-demonstrations", state="latent", task_batch_size=8)
    assert algorithm.config.demonstration_share == 0.25
    batches = spy_batches(algorithm)
    data, _ = play(algorithm, 45)
    steps = bank.seen().steps
    frames = steps.latents(torch.arange(len(steps.latent)))
    of_frame = torch.repeat_interleave(bank.seen().task, steps.length)
    n_batches = 0
    for batch in batches:
        assert batch.shape == (2, N_TASKS, 8)
        for seed, task in batch["priority_weight"].all(-1).nonzero().tolist():
            latents = batch["latent"][seed, task].unsqueeze(1)
            played = (latents == data["latent"][seed]).all(-1).any(-1)
            shown = (latents == frames).all(-1)
            assert shown.any(-1).tolist() == 2 * [False, False, False, True]
            assert played.equal(~shown.any(-1))
            assert (of_frame[shown[[3, 7]].long().argmax(-1)] == task).all()
            n_batches += 1
    assert n_batches > 50
