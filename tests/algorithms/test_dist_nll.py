"""Dist-NLL: who learns from what and when."""

from copy import deepcopy
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from bgpo_trl.algorithms import dist_nll
from bgpo_trl.modules.multi_head_actor import MultiHeadActor
from bgpo_trl.seeding import generators
from bgpo_trl.transforms import TaskSchedule
from tests.algorithms.playing import (
    SCHEDULE,
    assert_same,
    choice,
    perceptron,
    play,
    snapshot,
    weights_of,
)
from tests.helpers import spied

pytestmark = pytest.mark.usefixtures("easy_world")
SEEDS = (4, 6)
OTHER_SCHEDULE = TaskSchedule((4, 0, 2))  # by which task 1 comes first and task 0 last
SIZE, N_TASKS = 16, 3  # of the ground truth, and tasks


@pytest.fixture
def make(make_task_algorithm):
    return lambda name="dist-nll", **changes: make_task_algorithm(name, **changes)


def test_teachers_learn_from_demonstrations_too_and_students_do_not(make, bank):
    """All frames of demonstrations are turned round in one of two runs."""
    steps = bank.seen().steps
    other = replace(bank, steps=replace(bank.steps, latent=-bank.steps.latent))
    options = {"state": "latent", "name": "dist-nll-demonstrations"}
    first, second = make(**options), make(bank=other, **options)
    learned = [spied(algorithm, "learn") for algorithm in (first, second)]
    for algorithm in (first, second):
        play(algorithm, 30)
    batches = [calls[0][0][0] for calls in learned]  # before anything could come of it
    ready = batches[0]["priority_weight"][..., 0] > 0
    assert ready.any()
    ours, theirs = (batch["latent"][ready] for batch in batches)
    assert ours[:, :3].equal(theirs[:, :3])
    assert ours[:, 3:].equal(-theirs[:, 3:])
    sampled = first.replay.sample(torch.zeros(1, 200, dtype=torch.int64), seeds=[0])["latent"]
    frames = steps.latents(torch.arange(len(steps.latent)))
    assert not (sampled.view(-1, 1, 64) == frames).all(-1).any()


@pytest.mark.parametrize("schedule", [SCHEDULE, OTHER_SCHEDULE])
def test_students_learn_from_their_teachers_at_the_end_of_each_episode(make, schedule):
    """Whole runs of plain supervised learners: heads, draws, labels, losses, steps of Adam."""
    algorithm = make(schedule=schedule)
    seen = [[[] for _ in range(N_TASKS)] for _ in SEEDS]
    draws = generators(SEEDS, "replay")
    students = [
        MultiHeadActor(SIZE, in_keys=["state"], hidden_sizes=(64,), generator=stream)
        for stream in generators(SEEDS, "student")
    ]
    heads, orders = generators(SEEDS, "heads"), [[], []]
    optimizers = [torch.optim.Adam(student.parameters(), lr=1e-3) for student in students]
    lessons, ended, state = [0, 0], [False, False], algorithm.world.env.reset()

    def draw(index, tasks, number):
        shares = torch.rand(len(tasks) * number, generator=draws[index], dtype=torch.float64)
        known = [torch.stack(seen[index][task]) for task in tasks]
        rows = zip(known, shares.view(-1, number), strict=True)
        return torch.stack([states[(share * len(states)).long()] for states, share in rows])

    def learn(index, ready):
        student, order, optimizer = students[index], orders[index], optimizers[index]
        for task in ready:
            if task not in order:
                order.append(task)
                head = student.add_head(heads[index])
                optimizer.add_param_group({"params": list(head.parameters())})
        states = draw(index, order, 24)
        teachers = algorithm.learner.loss.actor_network_params
        actions = [
            perceptron(weights_of(teachers, index, task), of_task).tanh()
            for task, of_task in zip(order, states, strict=True)
        ]
        for half in (slice(0, 12), slice(12, 24)):
            told = student(TensorDict({"state": states[:, half]}, [len(order), 12]))
            policy = torch.distributions.Normal(told["loc"], told["scale"])
            loss = -policy.log_prob(torch.stack(actions)[:, half]).sum(-1).mean(-1).sum()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        lessons[index] += 1

    for step in range(40):
        state = algorithm.act(state)
        before = [deepcopy(student.state_dict()) for student in algorithm.students]
        updated = algorithm.update()
        assert bool(updated) == (step >= 10)  # three times three, and one
        for index, student in enumerate(algorithm.students):
            ready = [task for task in range(N_TASKS) if len(seen[index][task]) >= 4]
            if updated and ready:
                draw(index, ready, 4)  # what the teachers learn from
            if updated and ended[index]:
                learn(index, ready)
                assert not student.state_dict()["trunk.layers.0.weight"].equal(
                    before[index]["trunk.layers.0.weight"]
                )
            else:
                assert_same(dict(student.state_dict()), dict(before[index]))
            for ours, theirs in zip(
                student.parameters(), students[index].parameters(), strict=True
            ):
                torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)
        transition, state = algorithm.world.env.step_and_maybe_reset(state)
        algorithm.store(transition)
        for index in range(2):
            seen[index][int(transition["task"][index])].append(transition["state"][index])
        ended = transition["next", "done"].flatten().tolist()

    assert min(lessons) > 4
    assert lessons[0] != lessons[1]
    for index, order in enumerate(orders):
        assert sorted(order) == [0, 1, 2]
        assert schedule is SCHEDULE or order.index(1) < order.index(0)
        frozen = snapshot(algorithm, index).parameters
        for position, task in enumerate(order):
            for name, value in students[index].heads[position].state_dict().items():
                expected = frozen[f"mlp.layers.1.{name}"][task]
                torch.testing.assert_close(expected, value[..., :4], rtol=1e-4, atol=1e-5)
            for name, value in students[index].trunk.state_dict().items():
                expected = frozen[f"mlp.{name}"][task]
                torch.testing.assert_close(expected, value, rtol=1e-4, atol=1e-5)


def test_students_learn_what_their_teachers_do_in_tests(make, monkeypatch):
    """The clone of one task, and what the critics choose in the others."""
    algorithm = make("dist-nll-demonstrations", state="latent")
    play(algorithm, 60)
    algorithm.proposals.clone_is_better = lambda seed, task: task == 0
    algorithm.learner.policy.caution = 0.0  # of critics that have learned little, few agree
    taught = spied(dist_nll, "distillation_loss", monkeypatch)
    algorithm._distill(1)
    loss, chosen = algorithm.learner.loss, set()
    assert len(algorithm._head_tasks[1]) == N_TASKS
    for row, task in enumerate(algorithm._head_tasks[1]):
        actor, clone = (
            weights_of(parameters, 1, task)
            for parameters in (loss.actor_network_params, loss.clone_network_params)
        )
        critics = [weights_of(loss.target_value_network_params, 1, task, n) for n in range(5)]
        for (_, part), _ in taught:
            for state, told in zip(part["latent"][row], part["teacher_action"][row], strict=True):
                action = choice(actor, clone, critics, state, only_clone=task == 0, caution=0)
                torch.testing.assert_close(told, action, rtol=1e-4, atol=1e-5)
                is_own = action.equal(perceptron(actor, state).tanh())
                chosen.add((task > 0, is_own))
    assert chosen == {(False, False), (True, False), (True, True)}


def test_no_end_of_an_episode_is_missed_between_updates(make, monkeypatch):
    algorithm, distilled = make(), []
    monkeypatch.setattr(algorithm, "_distill", distilled.append)
    state, ended, expected = algorithm.world.env.reset(), set(), []
    for step in range(40):
        transition, state = algorithm.world.env.step_and_maybe_reset(algorithm.act(state))
        algorithm.store(transition)
        ended |= {*transition["next", "done"].flatten().nonzero().flatten().tolist()}
        if step % 3 == 2:
            expected += sorted(ended) if algorithm.update() else []
            ended = set()
    assert distilled == expected
    assert {*distilled} == {0, 1}


def test_a_task_of_which_nothing_is_known_has_a_head_that_does_nothing(make):
    algorithm = make(schedule=TaskSchedule((0, 99, 99)))
    start = snapshot(algorithm, 0).parameters
    play(algorithm, 40)
    frozen = snapshot(algorithm, 0).parameters
    assert {key: value.shape for key, value in start.items()} == {
        key: value.shape for key, value in frozen.items()
    }
    for task in range(N_TASKS):
        assert not start["mlp.layers.1.weight"][task].any()
        assert bool(frozen["mlp.layers.1.weight"][task].any()) == (task == 0)
