"""MAML as a whole: by what it acts, what it adapts to, and that seeds share nothing."""

from copy import deepcopy
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torch.nn.functional import layer_norm

from bgpo_trl.algorithms.algorithm import Policy
from bgpo_trl.algorithms.maml import MAML
from bgpo_trl.configs import MAMLConfig
from bgpo_trl.files.checkpoint import load_checkpoint, save_checkpoint
from bgpo_trl.modules.actor_critic import Actor
from bgpo_trl.seeding import generators
from bgpo_trl.transforms import TaskSchedule
from tests.algorithms.playing import assert_same, play

pytestmark = pytest.mark.usefixtures("easy_world")
SEEDS = (4, 6)
SCHEDULE = TaskSchedule((0, 2, 4))
SIZE, N_TASKS = 16, 3  # of the ground truth, and tasks
DEMONSTRATIONS = {"state": "latent", "name": "maml-demonstrations", "task_batch_size": 8}


@pytest.fixture
def make(bank, encoders, make_config, in_world):
    def make(seeds=SEEDS, schedule=SCHEDULE, state="state", name="maml", **changes):
        config = make_config(state, name).algorithm
        config = replace(config, **{"task_batch_size": 4, **changes})
        of_tasks = bank.for_tasks(bank.tasks[: schedule.n_tasks])
        algorithm = MAML(config, seeds=seeds, bank=of_tasks.seen(), encoders=encoders)
        return in_world(algorithm, seeds, schedule, of_tasks)

    return make


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


@pytest.mark.parametrize(
    ("schedule", "changes"),
    [(SCHEDULE, {}), (TaskSchedule((0, 0, 0)), {}), (TaskSchedule((0, 0, 0)), DEMONSTRATIONS)],
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
        frozen, frozen_alone = snapshot(batch, index).parameters, snapshot(alone, 0).parameters
        for key, value in frozen.items():
            torch.testing.assert_close(value, frozen_alone[key], rtol=1e-4, atol=1e-4)
        losses.append(alone.update())
    assert together["task"].unique().tolist() == [0, 1, 2]
    for key, value in batch.update().items():
        expected = torch.cat([loss[key] for loss in losses])
        torch.testing.assert_close(value, expected, rtol=1e-3, atol=1e-4)


def test_latents_are_played_and_learned_from_too(make):
    algorithm = make(state="latent")
    start = [p.detach().clone() for p in algorithm.meta_actor.parameters()]
    data, _ = play(algorithm, 24)
    assert data["latent"].shape == (2, 24, 64)
    assert data.get("pixels", None) is None
    assert snapshot(algorithm, 1).parameters["mlp.layers.0.weight"].shape == (3, 64, 64)
    for value, before in zip(algorithm.meta_actor.parameters(), start, strict=True):
        assert not value.equal(before)


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
    play(algorithm, 1, state)
    for key, value in algorithm.loss.state_dict().items():
        if "target" not in key and "gamma" not in key:
            assert not value.equal(start[key]), key


def test_tasks_that_are_never_presented_make_no_difference(make):
    ddpg = replace(make().config.rl, warmup_steps=10)  # as many as three tasks need
    three, one = (make(schedule=TaskSchedule(s), rl=ddpg) for s in ((0, 99, 99), (0,)))
    ours, theirs = play(three, 30)[0], play(one, 30)[0]
    assert ours["demo_embedding"].equal(theirs["demo_embedding"])
    torch.testing.assert_close(ours["action"], theirs["action"], rtol=1e-4, atol=1e-5)
    for index in range(2):
        meta, meta_alone = meta_weights(three, index), meta_weights(one, index)
        for key, value in meta.items():
            torch.testing.assert_close(value, meta_alone[key], rtol=1e-4, atol=1e-5)
        frozen, frozen_alone = snapshot(three, index).parameters, snapshot(one, index).parameters
        for key, value in frozen.items():
            assert value[1].equal(meta[key])
            assert value[2].equal(meta[key])
            assert frozen_alone[key].shape[0] == 1
    critics = zip(three.critic.parameters(), one.critic.parameters(), strict=True)
    for value, alone in critics:
        torch.testing.assert_close(value[:, 0], alone[:, 0], rtol=1e-4, atol=1e-5)


def test_a_critic_stays_as_it_was_until_there_is_data_of_its_task(make):
    algorithm = make()
    names = ("value_network_params", "target_value_network_params")
    critics = [p for name in names for p in getattr(algorithm.loss, name).values(True, True)]
    start = [p.detach().clone() for p in critics]
    counts, learned = torch.zeros(2, N_TASKS).long(), torch.zeros(2, N_TASKS).bool()
    stages = []
    state = algorithm.world.env.reset()
    for _ in range(50):
        state = algorithm.act(state)
        if algorithm.update():
            learned |= counts >= algorithm.config.task_batch_size
        for now, before in zip(critics, start, strict=True):
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


def test_each_test_draws_its_own_transitions(make):
    algorithm = make()
    play(algorithm, 40)
    first, same, other = (
        snapshot(algorithm, 0, generator_seed=seed).parameters for seed in (5, 5, 6)
    )
    for key, value in first.items():
        assert value.equal(same[key])
        assert not value.equal(other[key])


def test_before_there_is_data_a_test_is_of_the_policy_as_it_starts(make):
    algorithm = make()
    for index in range(2):
        frozen, meta = snapshot(algorithm, index).parameters, meta_weights(algorithm, index)
        assert frozen.keys() == meta.keys()
        for key, value in frozen.items():
            assert value.equal(meta[key].expand_as(value))


def test_preparing_a_test_leaves_no_trace(make):
    algorithm = make()
    _, state = play(algorithm, 40)
    before = deepcopy(algorithm.state_dict())
    gradients = [deepcopy(p.grad) for p in algorithm.loss.parameters()]
    frozen = snapshot(algorithm, 1).parameters
    assert_same(deepcopy(algorithm.state_dict()), before)
    assert_same([p.grad for p in algorithm.loss.parameters()], gradients)
    copied = deepcopy(frozen)
    play(algorithm, 10, state)
    for key, value in frozen.items():
        assert not value.requires_grad
        assert value.equal(copied[key])
        assert not value.equal(snapshot(algorithm, 1).parameters[key])


def test_snapshots_act_as_plain_ones_with_these_weights(make):
    algorithm = make()
    play(algorithm, 40)
    frozen = [snapshot(algorithm, index) for index in range(2)]
    stacked = Policy.stack(frozen)
    state = torch.randn(2, N_TASKS, 5, SIZE, generator=torch.Generator().manual_seed(0))
    actions = stacked.act(state)
    assert actions.shape == (2, N_TASKS, 5, 4)
    for index in range(2):
        for task in range(N_TASKS):
            alone = Actor(SIZE, in_keys=["state"], hidden_sizes=(64,))
            weights = {key: value[task] for key, value in frozen[index].parameters.items()}
            alone.load_state_dict(weights)
            expected = alone(TensorDict({"state": state[index, task]}, [5]))["action"]
            torch.testing.assert_close(actions[index, task], expected)
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


@pytest.mark.parametrize("changes", [{}, DEMONSTRATIONS])
def test_a_restored_run_continues_as_the_saved_one(make, tmp_path, changes):
    algorithm = make(**changes)
    _, state = play(algorithm, 20)
    parts = {"algorithm": algorithm.state_dict(), "world": algorithm.world.state_dict()}
    save_checkpoint(tmp_path, {**parts, "state": state.to_dict()})
    other = make(seeds=(5, 7), **changes)  # other weights, streams and simulations
    play(other, 12)
    saved = load_checkpoint(tmp_path)
    other.world.load_state_dict(saved["world"])
    other.load_state_dict(saved["algorithm"])
    ours, _ = play(algorithm, 20, state)
    theirs, _ = play(other, 20, TensorDict(saved["state"], [2]))
    assert (ours == theirs).all()
    assert_same(deepcopy(algorithm.state_dict()), deepcopy(other.state_dict()))
    assert_same(snapshot(algorithm, 1).parameters, snapshot(other, 1).parameters)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("inner_learning_rate", -0.1),
        ("task_batch_size", 0),
        ("task_batch_size", 7),  # one half is to adapt to, the other to judge by
        ("adaptation_size", 0),
    ],
)
def test_settings_without_a_meaning_are_refused(name, value):
    with pytest.raises(ValueError, match=f"^{name} must be .*, got {value}$"):
        MAMLConfig(**{name: value})


def test_a_replay_too_small_to_fill_a_batch_is_refused(make, make_config):
    rl = make_config("state", "maml").algorithm.rl
    # Three tasks have a full batch of 8 among them after 3 * 7 + 1 transitions.
    small = {"task_batch_size": 8, "rl": replace(rl, replay_size=22)}
    make(**small)
    with pytest.raises(ValueError, match=r"replay_size must be at least 22, .* learning begins"):
        make(**{**small, "rl": replace(rl, replay_size=21)})


def test_targets_are_clipped_to_the_attainable_returns(make):
    assert make().loss.return_bounds == (0.0, 1.0)
