"""Dist-NLL as a whole: who acts, who learns from what and when, and that seeds share nothing."""

import math
from copy import deepcopy
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from bgpo_trl.algorithms.algorithm import Policy
from bgpo_trl.algorithms.dist_nll import DistNLL
from bgpo_trl.configs import DistNLLConfig
from bgpo_trl.files.checkpoint import load_checkpoint, save_checkpoint
from bgpo_trl.modules.multi_head_actor import MultiHeadActor
from bgpo_trl.seeding import generators
from bgpo_trl.transforms import TaskSchedule
from tests.algorithms.playing import assert_same, play

pytestmark = pytest.mark.usefixtures("easy_world")
SEEDS = (4, 6)
SCHEDULE = TaskSchedule((0, 2, 4))
OTHER_SCHEDULE = TaskSchedule((4, 0, 2))  # by which task 1 comes first and task 0 last
SIZE, N_TASKS = 16, 3  # of the ground truth, and tasks
DEMONSTRATIONS = {"state": "latent", "name": "dist-nll-demonstrations"}


@pytest.fixture
def make(bank, encoders, make_config, in_world):
    def make(seeds=SEEDS, schedule=SCHEDULE, state="state", name="dist-nll", bank=bank, **changes):
        config = make_config(state, name).algorithm
        config = replace(config, **{"task_batch_size": 4, **changes})
        of_tasks = bank.for_tasks(bank.tasks[: schedule.n_tasks])
        algorithm = DistNLL(config, seeds=seeds, bank=of_tasks.seen(), encoders=encoders)
        return in_world(algorithm, seeds, schedule, of_tasks)

    return make


def teachers_action(algorithm, seed, task, state):
    """Actions of a teacher, computed from its weights."""
    params = algorithm.loss.actor_network_params["mlp", "layers"]
    first, second = (
        {key: value.detach()[seed, task] for key, value in params[layer].items()} for layer in "01"
    )
    hidden = (state @ first["weight"] + first["bias"]).relu()
    return (hidden @ second["weight"] + second["bias"]).tanh()


def snapshot(algorithm, index, embedding=0.0):
    shape = (algorithm.n_tasks, 2)
    task = torch.arange(algorithm.n_tasks).unsqueeze(1).expand(shape)
    return algorithm.snapshot(index, torch.full((*shape, 32), embedding), task, torch.Generator())


def head_weights(student):
    return [{key: p.detach().clone() for key, p in h.named_parameters()} for h in student.heads]


@pytest.mark.parametrize(
    ("schedule", "changes"),
    [(SCHEDULE, {}), (TaskSchedule((0, 0, 0)), {}), (TaskSchedule((0, 0)), DEMONSTRATIONS)],
)
def test_a_seed_learns_in_a_batch_as_it_does_alone(make, schedule, changes):
    batch = make(schedule=schedule, **changes)
    together, _ = play(batch, 40)
    losses = []
    for index, seed in enumerate(SEEDS):
        alone = make(seeds=(seed,), schedule=schedule, **changes)
        data = play(alone, 40)[0][0]
        for key in ("task", "demo_index", "step_count", ("next", "terminated")):
            assert together[index][key].equal(data[key]), key
        for key in ("action", batch.config.state, ("next", "reward")):
            torch.testing.assert_close(together[index][key], data[key], rtol=1e-4, atol=1e-4)
        for (key, ours), theirs in zip(
            batch.loss.state_dict().items(), alone.loss.state_dict().values(), strict=True
        ):
            if ours.ndim:  # not the discount
                torch.testing.assert_close(ours[index], theirs[0], rtol=1e-4, atol=1e-4, msg=key)
        student, student_alone = batch.students[index], alone.students[0]
        assert len(student.heads) == len(student_alone.heads) == batch.n_tasks
        for ours, theirs in zip(student.parameters(), student_alone.parameters(), strict=True):
            torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4)
        losses.append(alone.update())
    assert together["task"].unique().tolist() == list(range(batch.n_tasks))
    for key, value in batch.update().items():
        expected = torch.cat([loss[key] for loss in losses])
        torch.testing.assert_close(value, expected, rtol=1e-3, atol=1e-4)


def test_latents_are_played_and_learned_from_too(make):
    algorithm = make(state="latent", schedule=TaskSchedule((0,)))
    start = [deepcopy(student.state_dict()) for student in algorithm.students]
    data, _ = play(algorithm, 24)
    assert data["latent"].shape == (2, 24, 64)
    assert data.get("pixels", None) is None
    for student, before in zip(algorithm.students, start, strict=True):
        assert len(student.heads) == 1
        for key, value in before.items():
            assert not value.equal(student.state_dict()[key])


def test_training_episodes_are_played_by_the_teacher_of_their_task_with_noise(make):
    algorithm = make()
    noise = generators(SEEDS, "exploration")
    clamped, tasks = set(), set()

    def watch(chosen):
        for index, source in enumerate(noise):
            task = int(chosen["task"][index])
            action = teachers_action(algorithm, index, task, chosen["state"][index])
            noisy = action + 0.3 * torch.randn(4, generator=source)
            torch.testing.assert_close(chosen["action"][index], noisy.clamp(-1, 1))
            clamped.add(bool((noisy.abs() > 1).any()))
            tasks.add(task)

    play(algorithm, 40, watch=watch)
    assert clamped == {True, False}
    assert tasks == {0, 1, 2}


@pytest.mark.parametrize(("warmup", "n_tasks", "expected"), [(8, 3, 10), (8, 1, 8), (15, 3, 15)])
def test_the_first_update_comes_after_the_warm_up_when_some_task_fills_a_batch_for_sure(
    make, warmup, n_tasks, expected
):
    """Three tasks can have three transitions each without four of any."""
    ddpg = replace(make().config.rl, warmup_steps=warmup)
    algorithm = make(schedule=TaskSchedule((0,) * n_tasks), rl=ddpg)
    start = deepcopy(dict(algorithm.loss.state_dict()))
    _, state = play(algorithm, expected)  # with an update before each step
    assert_same(dict(algorithm.loss.state_dict()), start)
    assert not any(len(student.heads) for student in algorithm.students)
    play(algorithm, 1, state)
    for key, value in algorithm.loss.state_dict().items():
        assert "gamma" in key or not value.equal(start[key])


def test_tasks_that_are_never_presented_make_no_difference(make):
    ddpg = replace(make().config.rl, warmup_steps=10)  # as many as three tasks need
    three, one = (make(schedule=TaskSchedule(s), rl=ddpg) for s in ((0, 99, 99), (0,)))
    start = deepcopy(dict(three.loss.state_dict()))
    ours, theirs = play(three, 30)[0], play(one, 30)[0]
    assert ours["demo_embedding"].equal(theirs["demo_embedding"])
    torch.testing.assert_close(ours["action"], theirs["action"], rtol=1e-4, atol=1e-5)
    for key, value in three.loss.state_dict().items():
        if value.ndim:  # not the discount
            alone = one.loss.state_dict()[key]
            torch.testing.assert_close(value[:, 0], alone[:, 0], rtol=1e-4, atol=1e-5)
            assert not value[:, 0].equal(start[key][:, 0])
            assert value[:, 1:].equal(start[key][:, 1:])
    for student, alone in zip(three.students, one.students, strict=True):
        assert len(student.heads) == 1
        for value, other in zip(student.parameters(), alone.parameters(), strict=True):
            torch.testing.assert_close(value, other, rtol=1e-4, atol=1e-5)


def test_a_teacher_stays_as_it_was_until_there_is_data_of_its_task(make):
    algorithm = make()
    parts = [*algorithm.loss.state_dict().items()]
    weights = [value for key, value in parts if value.ndim]  # not the discount
    start = [value.clone() for value in weights]
    counts, learned = torch.zeros(2, N_TASKS).long(), torch.zeros(2, N_TASKS).bool()
    stages = []
    state = algorithm.world.env.reset()
    for _ in range(40):
        state = algorithm.act(state)
        if algorithm.update():
            learned |= counts >= algorithm.config.task_batch_size
        for now, before in zip(weights, start, strict=True):
            changed = (now != before).flatten(2).any(-1)
            assert changed.equal(learned)
        stages.append(tuple(learned.flatten().tolist()))
        transition, state = algorithm.world.env.step_and_maybe_reset(state)
        algorithm.store(transition)
        counts[torch.arange(2), transition["task"]] += 1
        assert algorithm.replay.sizes(torch.arange(N_TASKS).expand(2, -1)).equal(counts)
    assert not any(stages[0])
    assert all(stages[-1])
    assert len(set(stages)) > 3


def test_a_teacher_learns_from_the_transitions_of_its_own_task_only(make):
    """All that happens in task 1 is changed in one of two runs."""
    generator = torch.Generator().manual_seed(0)

    def draw(*size):
        return torch.rand(2, *size, generator=generator) * 2 - 1

    first, second = make(), make()
    for step in range(40):
        transition = {
            "state": draw(SIZE),
            "action": draw(4),
            "task": torch.tensor([step % 3, step % 2]),
            "next": {
                "state": draw(SIZE),
                "reward": draw(1),
                "terminated": draw(1) > 0,
                "done": torch.zeros(2, 1, dtype=torch.bool),
            },
        }
        transition = TensorDict(transition, [2])
        first.update()
        second.update()
        first.store(transition)
        others = transition["task"].unsqueeze(-1) != 1
        changed = transition.clone()
        for key in ("state", "action", ("next", "state"), ("next", "reward")):
            changed[key] = transition[key].where(others, -transition[key])
        second.store(changed)
    compared = 0
    for key, value in first.loss.state_dict().items():
        if value.ndim:  # not the discount
            differs = (value != second.loss.state_dict()[key]).flatten(2).any(-1)
            assert differs.tolist() == 2 * [[False, True, False]], key
            compared += 1
    assert compared == 16


def test_teachers_learn_from_demonstrations_too_and_students_do_not(make, bank):
    """All frames of demonstrations are turned round in one of two runs."""
    steps = bank.seen().steps
    other = replace(bank, steps=replace(bank.steps, latent=-bank.steps.latent))
    first, second = make(**DEMONSTRATIONS), make(bank=other, **DEMONSTRATIONS)
    assert len(steps.latent)
    batches = []
    for algorithm in (first, second):
        learned, learn = [], algorithm.learn

        def spy(batch, learned=learned, learn=learn):
            learned.append(batch.clone())
            return learn(batch)

        algorithm.learn = spy
        play(algorithm, 30)
        batches.append(learned[0])  # before anything could come of it
    ready = batches[0]["priority_weight"][..., 0] > 0
    assert ready.any()
    ours, theirs = (batch["latent"][ready] for batch in batches)
    assert ours[:, :3].equal(theirs[:, :3])
    assert ours[:, 3:].equal(-theirs[:, 3:])
    sampled = first.replay.sample(torch.zeros(1, 200, dtype=torch.int64), seeds=[0])["latent"]
    frames = steps.latents(torch.arange(len(steps.latent)))
    assert not (sampled.view(-1, 1, 64) == frames).all(-1).any()


def plain_nll(loc, scale, action):
    nll = scale.log() + 0.5 * math.log(2 * math.pi) + (action - loc).square() / (2 * scale**2)
    return nll.sum(-1).mean(-1).sum()


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
        return torch.stack(
            [
                torch.stack(
                    [seen[index][task][int(share * len(seen[index][task]))] for share in row]
                )
                for task, row in zip(tasks, shares.view(-1, number), strict=True)
            ]
        )

    def learn(index, ready):
        student, order, optimizer = students[index], orders[index], optimizers[index]
        for task in ready:
            if task not in order:
                order.append(task)
                head = student.add_head(heads[index])
                optimizer.add_param_group({"params": list(head.parameters())})
        states = draw(index, order, 24)
        actions = [
            teachers_action(algorithm, index, task, of_task)
            for task, of_task in zip(order, states, strict=True)
        ]
        for half in (slice(0, 12), slice(12, 24)):
            told = student(TensorDict({"state": states[:, half]}, [len(order), 12]))
            loss = plain_nll(told["loc"], told["scale"], torch.stack(actions)[:, half])
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
                expected = frozen[f"heads.{task}.{name}"]
                torch.testing.assert_close(expected, value, rtol=1e-4, atol=1e-5)


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


def test_old_heads_and_the_trunk_are_kept_when_a_head_is_added(make):
    """Seen where learning changes nothing: the weights are all as they were drawn."""
    algorithm = make(learning_rate=1e-30)  # none to speak of, so that only the head is new
    start = [deepcopy(student.trunk.state_dict()) for student in algorithm.students]
    numbers = []
    state = algorithm.world.env.reset()
    for _ in range(40):
        _, state = play(algorithm, 1, state)
        numbers.append(tuple(len(student.heads) for student in algorithm.students))
        for student, trunk, source in zip(
            algorithm.students, start, generators(SEEDS, "heads"), strict=True
        ):
            assert_same(dict(student.trunk.state_dict()), dict(trunk))
            drawn = MultiHeadActor(SIZE, in_keys=["state"], hidden_sizes=(64,))
            for head in student.heads:
                assert_same(dict(head.state_dict()), dict(drawn.add_head(source).state_dict()))
    assert {number for of_seeds in numbers for number in of_seeds} == {0, 1, 2, 3}


def test_each_head_comes_to_do_what_the_teacher_of_its_task_does(make):
    """Teachers who each insist on something; task 1 is the first to appear."""
    algorithm = make(schedule=OTHER_SCHEDULE, learning_rate=1e-2)
    data, _ = play(algorithm, 45)
    assert (algorithm.ready_tasks() >= 0).all()
    wanted = torch.tensor([[0.8, -0.8, 0.5, 0.0], [-0.8, 0.8, 0.0, -0.5], [0.0, 0.0, 0.7, 0.7]])
    params = algorithm.loss.actor_network_params["mlp", "layers", "1"]
    with torch.no_grad():
        params["weight"].mul_(0.01)
        params["bias"].copy_(wanted.atanh().expand(2, 3, 4))
    for group in algorithm.learner.optimizer.param_groups:
        group["lr"] = 0.0  # they have learned enough
    data["next", "done"][:] = True
    for step in range(90):  # twice over, each step an end
        algorithm.store(data[:, step % 45])
        algorithm.update()
    for index in range(2):
        for task in range(N_TASKS):
            states = data["state"][index][data["task"][index] == task]
            policy = Policy.stack([snapshot(algorithm, index)] * 2)
            actions = policy.act(states.expand(2, N_TASKS, -1, -1))[:, task]
            expected = wanted[task].expand_as(actions)
            torch.testing.assert_close(actions, expected, rtol=0, atol=0.1)


def test_a_task_of_which_nothing_is_known_has_a_head_that_does_nothing(make):
    algorithm = make(schedule=TaskSchedule((0, 99, 99)))
    start = snapshot(algorithm, 0).parameters
    play(algorithm, 40)
    frozen = snapshot(algorithm, 0).parameters
    assert {key: value.shape for key, value in start.items()} == {
        key: value.shape for key, value in frozen.items()
    }
    for task in range(N_TASKS):
        assert not start[f"heads.{task}.weight"].any()
        assert bool(frozen[f"heads.{task}.weight"].any()) == (task == 0)


def test_preparing_a_test_leaves_no_trace_and_is_not_changed_later(make):
    algorithm = make()
    _, state = play(algorithm, 40)
    before = deepcopy(algorithm.state_dict())
    frozen = snapshot(algorithm, 1).parameters
    assert_same(deepcopy(algorithm.state_dict()), before)
    copied = deepcopy(frozen)
    play(algorithm, 20, state)
    assert_same(frozen, copied)
    assert not frozen["heads.0.weight"].equal(snapshot(algorithm, 1).parameters["heads.0.weight"])


def test_snapshots_act_as_plain_ones_with_these_weights(make):
    algorithm = make()
    play(algorithm, 40)
    frozen = [snapshot(algorithm, index) for index in range(2)]
    stacked = Policy.stack(frozen)
    state = torch.randn(2, N_TASKS, 5, SIZE, generator=torch.Generator().manual_seed(0))
    actions = stacked.act(state)
    for index in range(2):
        alone = MultiHeadActor(SIZE, in_keys=["state"], hidden_sizes=(64,))
        for _ in range(N_TASKS):
            alone.add_head()
        alone.load_state_dict(frozen[index].parameters)
        expected = alone(TensorDict({"state": state[index]}, [N_TASKS, 5]))["action"]
        torch.testing.assert_close(actions[index], expected)
    # Later learning makes no difference.
    play(algorithm, 10)
    assert stacked.act(state).equal(actions)


def test_demonstrations_are_never_read(make):
    told, untold = make(), make()
    ours, _ = play(told, 40)
    theirs, _ = play(untold, 40, hidden=["demo_embedding"])
    assert ours["task"].unique().tolist() == [0, 1, 2]
    for key in ("action", "state", "demo_index", ("next", "reward")):
        assert ours[key].equal(theirs[key]), key
    assert_same(dict(told.loss.state_dict()), dict(untold.loss.state_dict()))
    for index in range(2):
        blind = snapshot(untold, index, embedding=float("nan"))
        assert_same(snapshot(told, index).parameters, blind.parameters)


@pytest.mark.parametrize(
    ("n_steps", "changes"), [(5, {}), (20, {}), (40, {}), (5, DEMONSTRATIONS), (40, DEMONSTRATIONS)]
)
def test_a_restored_run_continues_as_the_saved_one(make, tmp_path, n_steps, changes):
    algorithm = make(schedule=OTHER_SCHEDULE, **changes)
    _, state = play(algorithm, n_steps)
    n_heads = [len(student.heads) for student in algorithm.students]
    parts = {"algorithm": algorithm.state_dict(), "world": algorithm.world.state_dict()}
    save_checkpoint(tmp_path, {**parts, "state": state.to_dict()})
    other = make(seeds=(5, 7), schedule=OTHER_SCHEDULE, **changes)  # other weights and streams
    saved = load_checkpoint(tmp_path)
    other.world.load_state_dict(saved["world"])
    other.load_state_dict(saved["algorithm"])
    assert [len(student.heads) for student in other.students] == n_heads
    assert_same(snapshot(algorithm, 0).parameters, snapshot(other, 0).parameters)
    ours, _ = play(algorithm, 20, state)
    theirs, _ = play(other, 20, TensorDict(saved["state"], [2]))
    assert (ours == theirs).all()
    assert_same(deepcopy(algorithm.state_dict()), deepcopy(other.state_dict()))
    assert [len(student.heads) for student in other.students] > n_heads or min(n_heads) == 3


@pytest.mark.parametrize(("size", "need"), [(0, "at least 1"), (7, "must be a multiple of")])
def test_samples_that_cannot_be_cut_in_batches_are_refused(size, need):
    with pytest.raises(ValueError, match=rf"{need}.*\b{size}\b"):
        DistNLLConfig(samples=24, distillation_batch_size=size)
