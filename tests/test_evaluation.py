"""Test episodes against a plain loop over one environment, and what they must leave alone."""

import copy
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from bgpo_trl.algorithms import entry
from bgpo_trl.algorithms.algorithm import Policy
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.evaluation import Evaluator, evaluate_random_policy
from bgpo_trl.modules.actor_critic import Actor, Critic, ProposalPolicy
from bgpo_trl.modules.multi_head_actor import MultiHeadActor
from bgpo_trl.seeding import stream_seed
from bgpo_trl.transforms import TaskSchedule
from suites import nico
from tests.algorithms.playing import assert_same, play
from tests.helpers import DISTINCT, spied

pytestmark = pytest.mark.usefixtures("easy_world")
SEEDS = (3, 8)
EPISODES = 2
# Until there is data of most tasks, where each has its own.
STEPS = {"maml": 50, "dist-nll": 80}  # and those named after them
every_kind = pytest.mark.parametrize("name", DISTINCT)


@pytest.fixture
def make(bank, encoders, make_config, in_world):
    """Make an algorithm that has played a little, and an evaluator for it."""

    def make(state="latent", name="bgpo", starts=(0, 2, 4), episodes=EPISODES):
        config = make_config(state, name, seeds=SEEDS)
        algorithm = entry(name).make(
            config.algorithm, seeds=SEEDS, bank=bank.seen(), encoders=encoders
        )
        in_world(algorithm, TaskSchedule(starts))
        evaluator = Evaluator(config, bank.held_out(), encoders, episodes=episodes, starts=starts)
        # Four episodes, after which all tasks are presented, take at most 24 steps.
        play(algorithm, next((n for start, n in STEPS.items() if name.startswith(start)), 25))
        return algorithm, evaluator

    return make


def last_biases(algorithm):
    """The biases of the last layers of the policies that play test episodes."""
    if hasattr(algorithm, "students"):
        return [head.bias for student in algorithm.students for head in student.heads]
    if hasattr(algorithm, "meta_actor"):
        return [algorithm.meta_actor.mlp.layers[-1].bias]
    named = algorithm.learner.loss.named_parameters()
    last = ("actor_network_params.mlp.layers.1.bias", "clone_network_params.mlp.layers.1.bias")
    return [parameter for name, parameter in named if name in last]


@torch.no_grad()
def turn(algorithm):
    """Make a policy turn the arm after some steps, which depend on its input."""
    for bias in last_biases(algorithm):
        bias.add_(0.1)


def take(evaluator, algorithm, number=0):
    episodes = algorithm.world.source.episode.tolist()
    return [
        evaluator.snapshot(algorithm, index, number, episode=episode)
        for index, episode in enumerate(episodes)
    ]


def assert_same_result(first, second):
    assert first.success.equal(second.success)
    assert first.steps.equal(second.steps)


def plain_policy(algorithm, snapshot, index, task, episode, phi):
    """The policy that is to play a test episode, with a single set of weights."""
    frozen, state = snapshot.policy.parameters, algorithm.config.state
    size = {"in_keys": [state], "hidden_sizes": (64,)}
    if hasattr(algorithm, "students"):  # one head for each task, in order of appearance
        student = algorithm.students[index]
        policy = MultiHeadActor(algorithm.state_size, **size)
        policy.trunk = student.trunk
        policy.heads.append(student.heads[algorithm._head_tasks[index].index(task)])
        return lambda seen: policy(TensorDict({state: seen[None]}, [1]))["action"][0].detach()
    if hasattr(algorithm, "meta_actor"):  # weights for each task
        policy = Actor(algorithm.state_size, **size)
        policy.load_state_dict({key: value[task] for key, value in frozen.items()})
        return lambda seen: policy(TensorDict({state: seen}))["action"].detach()
    n_features = algorithm.learner.loss.actor_network.mlp.layers[0].in_features
    size["in_keys"], group = algorithm.in_keys, 0
    policy = Actor(n_features, **size)
    if algorithm.proposals is not None:
        critics = Critic(n_features, layer_norm=True, batch_size=(5,), **size)
        policy = ProposalPolicy(policy, Actor(n_features, **size), critics)
    if algorithm.config.experts:
        group = int(algorithm.groups[index].lookup(phi).group)
    policy.load_state_dict(algorithm.actor_weights(index, group))
    context = {}
    if snapshot.policy.context is not None:
        context = {"context": snapshot.policy.context[task, episode]}
    return lambda seen: policy(TensorDict({state: seen, **context}))["action"].detach()


@pytest.mark.parametrize(
    ("state", "name"),
    [
        ("latent", "bgpo"),
        ("latent", "without-gwr"),
        ("state", "oracle"),
        ("latent", "maml"),
        ("latent", "dist-nll"),
    ],
)
def test_test_episodes_equal_a_plain_loop_over_one_environment(
    make, encoders, easy_world, monkeypatch, state, name
):
    episodes = 4
    algorithm, evaluator = make(state, name, episodes=episodes)
    turn(algorithm)
    acted, copied = spied(Policy, "act", monkeypatch), spied(algorithm, "snapshot")
    snapshots = take(evaluator, algorithm, number=5)
    result = evaluator.run(snapshots)

    for index, seed in enumerate(SEEDS):
        rng = np.random.default_rng([stream_seed(seed, "evaluation"), 5])
        starts = rng.integers(2**32, size=(3, episodes))
        for task in range(3):
            for episode in range(episodes):
                (_, embedding, *_), _ = copied[index]
                phi = embedding[task, episode]
                policy = plain_policy(algorithm, snapshots[index], index, task, episode, phi)
                env = easy_world(
                    seed=[int(starts[task, episode])],
                    observation="state" if state == "state" else "pixels",
                )
                now = env.reset(TensorDict({"task": torch.tensor(task)}))
                steps, success = 0, False
                while steps < 6 and not success:
                    if state == "latent":
                        seen = encoders.frame_network.latent(now["pixels"])
                    else:
                        seen = algorithm.world.env.transform[0].forward(now.clone())["state"]
                    action = policy(seen.clamp(-5, 5))
                    _, taken = acted[steps * len(SEEDS) + index]  # seed by seed
                    torch.testing.assert_close(taken[task, episode], action, rtol=1e-3, atol=1e-3)
                    now = env.step(now.set("action", action))["next"]
                    steps += 1
                    success = bool(now["terminated"])
                assert bool(result.success[index, task, episode]) == success
                assert int(result.steps[index, task, episode]) == steps
    assert not copied[0][0][1].equal(copied[1][0][1])  # each seed draws its own demonstrations
    assert 0 < result.success.float().mean() < 1
    assert len(result.steps.unique()) > 2


@every_kind
def test_an_evaluation_depends_on_its_number_alone_and_leaves_no_trace(make, name):
    algorithm, evaluator = make(name=name)
    turn(algorithm)
    before, chance = copy.deepcopy(algorithm.state_dict()), torch.random.get_rng_state()
    snapshots = [take(evaluator, algorithm, number) for number in (0, 1, 0)]
    results = [evaluator.run(taken) for taken in snapshots]
    assert_same_result(results[0], results[2])
    assert not results[0].steps.equal(results[1].steps)
    assert_same(algorithm.state_dict(), before)
    assert torch.random.get_rng_state().equal(chance)


@every_kind
def test_a_snapshot_does_not_change_with_further_training(make, name):
    algorithm, evaluator = make(name=name)
    snapshots = take(evaluator, algorithm)
    before = evaluator.run(snapshots)
    policies = [replace(s.policy, **copy.deepcopy(s.policy.state_dict())) for s in snapshots]
    nodes = None if algorithm.gwr is None else algorithm.gwr.graph(0).weights
    with torch.no_grad():
        for bias in last_biases(algorithm):
            bias.add_(2)
    play(algorithm, 20)
    if nodes is not None:
        assert not algorithm.gwr.graph(0).weights.equal(nodes)
    for snapshot, policy in zip(take(evaluator, algorithm), policies, strict=True):
        for key, value in policy.parameters.items():
            assert key == "only_clone" or not snapshot.policy.parameters[key].equal(value), key

    for snapshot, policy in zip(snapshots, policies, strict=True):
        assert_same(snapshot.policy.state_dict(), policy.state_dict())
    assert_same_result(evaluator.run(snapshots), before)
    later = evaluator.run(take(evaluator, algorithm))
    assert not later.steps.equal(before.steps)


@pytest.mark.parametrize("starts", [(0, 2, 99), (99, 0, 99)])
def test_only_tasks_that_were_presented_are_tested(make, starts):
    algorithm, evaluator = make(starts=starts)
    presented = [start < 99 for start in starts]
    snapshots = take(evaluator, algorithm)
    result = evaluator.run(snapshots)
    for index, snapshot in enumerate(snapshots):
        assert snapshot.presented.tolist() == presented
        assert snapshot.episode == algorithm.world.source.episode[index] > 2
        assert (result.steps[index] > 0).all(-1).tolist() == presented
        assert not result.success[index, ~snapshot.presented].any()
        frames = torch.from_numpy(evaluator.simulation.frames()[index])
        assert frames.flatten(2).any(-1).all(-1).tolist() == presented  # others are never drawn


def test_a_bank_without_a_held_out_demonstration_of_a_task_is_refused(bank, encoders, make_config):
    train = bank.train | (bank.task == 1)
    incomplete = DemonstrationBank(bank.embedding, bank.task, train, bank.tasks).held_out()
    with pytest.raises(ValueError, match=f"no held-out demonstration of {nico.PAPER_TASKS[1]!r}"):
        Evaluator(make_config(), incomplete, encoders, episodes=1)


def test_a_half_without_a_held_out_demonstration_is_named(bank, encoders, make_config, refused):
    """Of one that is held out of each task, the test half has none."""
    rows = [(bank.task == task).nonzero()[0] for task in range(3)]
    train = torch.ones_like(bank.train).index_fill(0, torch.cat(rows), False)
    single = DemonstrationBank(bank.embedding, bank.task, train, bank.tasks)
    parts = {"encoders": encoders, "episodes": 1}
    Evaluator(make_config(), single.held_out("validation"), **parts)
    test = partial(Evaluator, make_config(held_out="test"), single.held_out("test"), **parts)
    refused(test, "in the test half", "hold two out of each task (held_out_per_task), as each half")


def test_success_of_random_actions_equals_a_plain_loop(easy_world):
    rate = evaluate_random_policy(tasks=nico.PAPER_TASKS[:2], episodes=5, seed=4, max_steps=3)

    generator = torch.Generator().manual_seed(4)
    actions = [torch.rand(2, 5, 4, generator=generator) * 2 - 1 for _ in range(3)]
    first_seed = stream_seed(4, "random policy") // 2
    expected = torch.zeros(2, 5)
    for task in range(2):
        for episode in range(5):
            env = easy_world(seed=first_seed + 5 * task + episode, observation="state")
            now = env.reset(TensorDict({"task": torch.tensor(task)}))
            for action in actions:
                if not now["done"]:
                    now = env.step(now.set("action", action[task, episode]))["next"]
            expected[task, episode] = now["done"]
    assert rate.equal(expected.mean(-1))
    assert 0 < rate.mean() < 1


def test_watch_is_called_at_the_start_and_after_each_step(make):
    algorithm, evaluator = make()
    shown = []
    result = evaluator.run(
        take(evaluator, algorithm), watch=lambda: shown.append(evaluator.simulation.frames())
    )
    assert len(shown) == int(result.steps.max()) + 1
    for index in np.ndindex(*result.steps.shape):
        frames = np.stack([frame[index] for frame in shown])
        changed = (frames[1:] != frames[:-1]).any((1, 2, 3))
        assert not changed[int(result.steps[index]) :].any()  # it stands still when it is over
    assert_same_result(result, evaluator.run(take(evaluator, algorithm)))
