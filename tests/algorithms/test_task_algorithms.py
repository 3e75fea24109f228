"""What MAML and Dist-NLL share: a network of each task, what they read, and independent seeds."""

from copy import deepcopy
from dataclasses import replace

import pytest
import torch

from bgpo_trl.seeding import generators
from bgpo_trl.transforms import TaskSchedule
from tests.algorithms.playing import assert_same, perceptron, play, weights_of
from tests.helpers import spied

pytestmark = pytest.mark.usefixtures("easy_world")
SEEDS = (4, 6)
N_TASKS = 3
both = pytest.mark.parametrize("name", ["maml", "dist-nll"])


@both
def test_training_episodes_are_played_by_the_network_of_their_task_with_noise(
    make_task_algorithm, name
):
    algorithm, noise, tasks = make_task_algorithm(name), generators(SEEDS, "exploration"), set()

    def watch(chosen):
        for index, source in enumerate(noise):
            task = int(chosen["task"][index])
            network = weights_of(algorithm.learner.loss.actor_network_params, index, task)
            action = perceptron(network, chosen["state"][index]).tanh()
            noisy = action + 0.3 * torch.randn(4, generator=source)
            torch.testing.assert_close(chosen["action"][index], noisy.clamp(-1, 1))
            tasks.add(task)

    play(algorithm, 40, watch=watch)
    assert tasks == {0, 1, 2}
    networks = weights_of(algorithm.learner.loss.actor_network_params, 0)["mlp.layers.1.weight"]
    assert not networks[0].equal(networks[1])


@both
@pytest.mark.parametrize(("warmup", "n_tasks", "expected"), [(8, 3, 10), (8, 1, 8), (15, 3, 15)])
def test_the_first_update_comes_after_the_warm_up_when_some_task_fills_a_batch_for_sure(
    make_task_algorithm, name, warmup, n_tasks, expected
):
    """Three tasks can have three transitions each without four of any."""
    ddpg = replace(make_task_algorithm(name).config.rl, warmup_steps=warmup)
    algorithm = make_task_algorithm(name, schedule=TaskSchedule((0,) * n_tasks), rl=ddpg)
    start = deepcopy(algorithm.learner.state_dict())
    _, state = play(algorithm, expected)  # with an update before each step
    assert_same(algorithm.learner.state_dict(), start)
    play(algorithm, 1, state)
    assert algorithm.learner.state_dict()["optimizer"]["state"]


@both
def test_tasks_can_share_a_batch_in_equal_parts(make_task_algorithm, name):
    """By hand: 24 transitions are 24 of one task, 12 of each of two, 8 of each of three."""
    schedule = TaskSchedule((0, 3, 6))
    algorithm = make_task_algorithm(name, schedule=schedule, task_batch_size=24, share_batch=True)
    learned, found = spied(algorithm, "learn"), set()
    data, _ = play(algorithm, 150)
    for (batch,), _ in learned:
        n_rows = batch.shape[-1]
        for index in range(2):
            counts = (batch["priority_weight"][index] > 0).sum(-1).tolist()
            share = 24 // sum(count > 0 for count in counts)
            assert {*counts} <= {0, share}
            assert n_rows >= share
            for task in range(N_TASKS):
                weight = batch["priority_weight"][index, task]
                # Means over all rows are means over those that count.
                torch.testing.assert_close(
                    weight.sum(), torch.tensor(float(n_rows * (counts[task] > 0)))
                )
                own = data["state"][index][data["task"][index] == task]
                states = batch["state"][index, task][weight > 0].unsqueeze(1)
                assert (states == own).all(-1).any(-1).all()
            if name == "maml":  # to adapt to, and to evaluate
                halves = (batch["priority_weight"][index] > 0).unflatten(-1, (2, -1)).sum(-1)
                assert halves[:, 0].equal(halves[:, 1])
            found.add(tuple(counts))
    assert {(24, 0, 0), (12, 12, 0), (8, 8, 8)} <= found


@both
def test_networks_stay_as_they_were_until_there_is_data_of_their_task(make_task_algorithm, name):
    """But for MAML's policies, which start from one that learns from all tasks."""
    algorithm = make_task_algorithm(name)
    of_tasks = {k: v for k, v in algorithm.learner.loss.state_dict().items() if v.ndim > 2}
    own = [v for key, v in of_tasks.items() if name != "maml" or "value" in key]
    start = [value.clone() for value in own]
    counts, learned = torch.zeros(2, N_TASKS).long(), torch.zeros(2, N_TASKS).bool()
    stages, state = [], algorithm.world.env.reset()
    for _ in range(50):
        state = algorithm.act(state)
        if algorithm.update():
            learned |= counts >= algorithm.config.task_batch_size
        for now, before in zip(own, start, strict=True):
            assert (now != before).flatten(2).any(-1).equal(learned)
        stages.append(tuple(learned.flatten().tolist()))
        transition, state = algorithm.world.env.step_and_maybe_reset(state)
        algorithm.store(transition)
        counts[torch.arange(2), transition["task"]] += 1
        assert algorithm.replay.sizes(torch.arange(N_TASKS).expand(2, -1)).equal(counts)
    assert not any(stages[0])
    assert all(stages[-1])
    assert len(set(stages)) > 3


def test_a_replay_too_small_to_fill_a_batch_is_refused(make_task_algorithm, make_config):
    rl = make_config("state", "maml").algorithm.rl
    # Three tasks have a full batch of 8 among them after 3 * 7 + 1 transitions.
    small = {"task_batch_size": 8, "rl": replace(rl, replay_size=22)}
    make_task_algorithm("maml", **small)
    with pytest.raises(ValueError, match=r"replay_size must be at least 22, .* learning begins"):
        make_task_algorithm("maml", **{**small, "rl": replace(rl, replay_size=21)})


@both
def test_a_batch_too_small_to_share_is_refused(make_task_algorithm, name):
    make_task_algorithm(name, task_batch_size=6, share_batch=True)
    with pytest.raises(ValueError, match=r"at least 6 where 3 tasks share it, .* got 4"):
        make_task_algorithm(name, task_batch_size=4, share_batch=True)


@both
def test_targets_are_clipped_to_the_attainable_returns(make_task_algorithm, name):
    assert make_task_algorithm(name).learner.loss.return_bounds == (0.0, 1.0)
