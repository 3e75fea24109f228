"""MAML: what it adapts to, and by what it judges the adapted policies."""

import pytest
import torch

from bgpo_trl.transforms import TaskSchedule
from tests.algorithms.playing import play, snapshot
from tests.helpers import spied

pytestmark = pytest.mark.usefixtures("easy_world")
N_TASKS = 3


def test_tests_adapt_to_drawn_transitions_of_a_task_that_has_enough(make_task_algorithm):
    options = {"adaptation_size": 20, "inner_learning_rate": 0.5}
    algorithm = make_task_algorithm("maml", schedule=TaskSchedule((0, 2, 99)), **options)
    assert algorithm.loss.inner_learning_rate == 0.5
    data, _ = play(algorithm, 40)
    adaptations = spied(algorithm.loss, "adapt")
    for index in range(2):
        frozen = snapshot(algorithm, index, seed=5).parameters
        (drawn,), adapted = adaptations[-1]
        draw = torch.randint(2**63 - 1, (), generator=torch.Generator().manual_seed(5))
        stream = torch.Generator().manual_seed(int(draw))
        shares = torch.rand(2 * 20, generator=stream, dtype=torch.float64).view(2, 20)
        seen = [data["state"][index][data["task"][index] == task] for task in range(N_TASKS)]
        assert [len(states) >= 4 for states in seen] == [True, True, False]
        for task in (0, 1):
            states = seen[task][(shares[task] * len(seen[task])).long()]
            assert drawn["state"][index, task].equal(states)
        for key, start in algorithm.meta_actor.named_parameters():
            assert frozen[key].equal(adapted[key][index])
            moved = (frozen[key] != start[index]).flatten(1).any(1)
            assert moved.tolist() == [True, True, False]


def test_tests_adapt_to_the_latest_transitions_of_a_task(make_task_algorithm):
    algorithm = make_task_algorithm("maml", adaptation_size=9, adapt_to_latest=True)
    data, _ = play(algorithm, 40)
    adaptations = spied(algorithm.loss, "adapt")
    first, second = (snapshot(algorithm, 1, seed=seed).parameters for seed in (5, 6))
    assert all(value.equal(second[key]) for key, value in first.items())
    (adapted_to,), _ = adaptations[0]
    for index in range(2):
        for task in range(N_TASKS):
            seen = data["state"][index][data["task"][index] == task][-9:]
            assert adapted_to["state"][index, task, : len(seen)].equal(seen)
            assert adapted_to["priority_weight"][index, task].sum().round() == 9


def test_each_half_of_a_tasks_batch_has_its_share_of_demonstrations(make_task_algorithm, bank):
    """One half is to adapt to, the other to judge the adapted policy by."""
    algorithm = make_task_algorithm("maml-demonstrations", state="latent", task_batch_size=8)
    assert algorithm.config.demonstration_share == 0.25
    learned = spied(algorithm, "learn")
    data, _ = play(algorithm, 45)
    steps = bank.seen().steps
    frames = steps.latents(torch.arange(len(steps.latent)))
    of_frame = torch.repeat_interleave(bank.seen().task, steps.length)
    n_batches = 0
    for (batch,), _ in learned:
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
