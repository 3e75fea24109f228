"""BGPO as a whole: what it sees, what it learns from, and that seeds share nothing."""

from copy import deepcopy
from dataclasses import replace
from functools import partial

import pytest
import torch
from torchrl.envs import check_env_specs

from bgpo_trl.algorithms import ABLATIONS
from bgpo_trl.algorithms.algorithm import Policy
from bgpo_trl.algorithms.bgpo import BGPO
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.transforms import BehaviorLookup, GroupLookup, TaskSchedule
from tests.algorithms.playing import (
    CHANGES,
    SCHEDULE,
    VARIANTS,
    assert_same,
    perceptron,
    play,
    weights,
)

pytestmark = pytest.mark.usefixtures("easy_world")
variants = pytest.mark.parametrize("variant", VARIANTS)


@variants
def test_each_variant_is_an_environment_with_the_input_it_is_named_after(make_bgpo, variant):
    algorithm = make_bgpo(variant, schedule=TaskSchedule((0, 0, 0)))
    for transform in algorithm.world.env.transform:
        if isinstance(transform, BehaviorLookup | GroupLookup):
            transform.learn = False
    check_env_specs(algorithm.world.env)

    state, told, _ = VARIANTS[variant]
    sizes = {"state": 16, "latent": 64, "context": 3 if told == "label" else 32}
    keys = [state] if told == "nothing" else [state, "context"]
    start = algorithm.act(algorithm.world.env.reset())
    actor, critic = algorithm.learner.actor, algorithm.learner.loss.value_network
    assert actor.in_keys == keys
    assert critic.in_keys == [*keys, "action"]
    assert actor.mlp.layers[0].in_features == sum(sizes[key] for key in keys)
    for key in keys:
        assert start[key].shape == (2, sizes[key])
    assert start["action"].shape == (2, 4)
    present = {
        "behavior": told in ("phi", "b"),
        "lae_h": told in ("phi", "b"),
        "behavior_node": told == "b",
        "group": variant in CHANGES,
        "pixels": False,
    }
    assert {key: key in start for key in present} == present
    if "behavior" in start:
        assert start["context"].equal(0.25 * start["behavior"])
        assert start["behavior"].equal(start["demo_embedding"]) == (told == "phi")
    # In tests and one-shot use, policies are conditioned by the same transforms.
    for index in range(2):
        given = algorithm.condition(index, start["demo_embedding"][index], start["task"][index])
        for key, value in given.items():
            assert value.equal(start[key][index]), key
        assert ("context" in given, "expert" in given) == ("context" in start, "expert" in start)


@pytest.mark.parametrize("variant", ["latent, phi", "all"])
def test_bgpo_never_reads_the_label(make_bgpo, variant):
    algorithm, blind = (make_bgpo(variant, known=15) for _ in range(2))
    seeing, _ = play(algorithm, 40)
    not_seeing, _ = play(blind, 40, hidden=["task"])
    kept = algorithm.replay.sample(torch.zeros(2, 1, dtype=torch.int64))
    assert "task" not in kept.keys(True)
    assert seeing["task"].unique().tolist() == [0, 1, 2]
    for key in ("action", "latent", "behavior", "demo_index", ("next", "reward")):
        assert seeing[key].equal(not_seeing[key]), key
    assert_same(weights(algorithm), weights(blind))
    for ours, theirs in zip(algorithm.groups, blind.groups, strict=True):
        assert_same(algorithm.gwr.graph(0), blind.gwr.graph(0))
        assert ours.numbers == theirs.numbers
        assert len(ours.numbers) > 1


@pytest.mark.parametrize("variant", ["ground truth, label", "latent, nothing"])
def test_a_reference_learns_the_same_from_whatever_demonstrations(make_bgpo, bank, variant):
    other = DemonstrationBank(-3 * bank.embedding.flip(0), bank.task, bank.train, bank.tasks)
    schedule = TaskSchedule((0, 0, 0))
    algorithm = make_bgpo(variant, schedule=schedule)
    elsewhere = make_bgpo(variant, schedule=schedule, bank=other)
    data, changed = play(algorithm, 30)[0], play(elsewhere, 30)[0]
    assert not data["demo_embedding"].equal(changed["demo_embedding"])
    for key in (*algorithm.in_keys, "action", "task", ("next", "reward")):
        assert data[key].equal(changed[key]), key
    assert_same(weights(algorithm), weights(elsewhere))
    if "context" in algorithm.in_keys:
        assert data["context"].equal(torch.eye(3)[data["task"]])
        assert data["task"].unique().tolist() == [0, 1, 2]


def act_in_tests(algorithm, state, embedding, task):
    policies = [
        algorithm.snapshot(index, embedding, task, torch.Generator())
        for index in range(algorithm.n_seeds)
    ]
    return Policy.stack(policies).act(state)


@pytest.mark.parametrize("bootstraps", [True, False])
def test_a_time_out_is_terminal_unless_it_bootstraps_and_pays_the_bonus_in_both(
    make_bgpo, bootstraps
):
    algorithm = make_bgpo("latent, b", max_steps=3, timeouts_bootstrap=bootstraps)
    data, _ = play(algorithm, 40)
    end = data["next"]
    late = (end["step_count"] == 3) & ~end["success"]
    assert late.sum() > 5
    assert (end["terminated"][late] == (not bootstraps)).all()
    assert end["done"][late].all()
    assert (end["intrinsic_reward"][late] > 0).all()
    stored = algorithm.replay.contents(1)[0]["next", "terminated"]
    assert stored.equal(end["terminated"][1])


@pytest.mark.parametrize("variant", ["latent, label", "latent, nothing", "all"])
def test_only_a_variant_with_a_label_acts_by_it(make_bgpo, bank, variant):
    algorithm = make_bgpo(variant, schedule=TaskSchedule((0, 0, 0)))
    embedding = bank.held_out().embedding.view(3, 4, 32)
    state = torch.randn(2, 3, 4, 64, generator=torch.Generator().manual_seed(0))
    first, second = (
        act_in_tests(algorithm, state, embedding, torch.full((3, 4), task)) for task in (0, 1)
    )
    assert first.shape == (2, 3, 4, 4)
    assert first.equal(second) == (variant != "latent, label")
    other = act_in_tests(algorithm, state, 5 - embedding.flip(0), torch.zeros(3, 4).long())
    assert first.equal(other) == (variant != "all")


def test_test_episodes_are_played_by_the_expert_of_their_demonstration(make_bgpo, bank):
    """By hand: the group of each demonstration, its expert's weights, what they do."""
    algorithm = make_bgpo("experts", schedule=TaskSchedule((0, 0, 0)), known=15)
    play(algorithm, 60)
    assert all(len(groups.numbers) > 2 for groups in algorithm.groups)
    shown = bank.held_out()
    embedding, task = shown.embedding.view(3, 4, 32), shown.task.view(3, 4)
    state = torch.randn(2, 3, 4, 64, generator=torch.Generator().manual_seed(0))
    before = deepcopy(algorithm.state_dict())
    actions = act_in_tests(algorithm, state, embedding, task)
    assert_same(algorithm.state_dict(), before)
    groups = torch.stack([of_seed.lookup(embedding).group for of_seed in algorithm.groups])
    behaviors = algorithm.gwr.lookup(embedding.expand(2, 3, 4, 32)).embedding
    assert all(len(of_seed.unique()) > 1 for of_seed in groups)
    for seed, t, m in torch.cartesian_prod(*map(torch.arange, groups.shape)).tolist():
        network = algorithm.actor_weights(seed, int(groups[seed, t, m]))
        x = torch.cat([state[seed, t, m], 0.25 * behaviors[seed, t, m]])
        torch.testing.assert_close(actions[seed, t, m], perceptron(network, x).tanh())


@pytest.mark.parametrize(
    ("variant", "changes", "highest"),
    [
        # A success now, or a time-out with its bonus and a success after it, 0.95 as much worth.
        ("all", {}, 0.1 + 0.95 * 1.1),
        ("latent, phi", {"beta": 0.3}, 0.3 + 0.95 * 1.3),
        ("latent, b", {"beta": 0.0}, 1.0),
        ("latent, nothing", {"beta": 0.3}, 1.0),
        ("latent, phi", {"timeouts_bootstrap": False}, 1.1),
    ],
)
def test_targets_are_clipped_to_the_attainable_returns(make_bgpo, variant, changes, highest):
    algorithm = make_bgpo(variant, **changes)
    play(algorithm, 7)
    target_bias = [
        value
        for key, value in algorithm.learner.loss.state_dict().items()
        if key.startswith("target_value") and key.endswith("bias")
    ][-1]
    n_experts = algorithm.learner.actor.batch_size[1]
    for bias, expected in ((50.0, highest), (-50.0, 0.0)):
        target_bias.fill_(bias)
        batch = algorithm.replay.sample(torch.zeros(2, 32, dtype=torch.int64))
        batch = batch.view(2, n_experts, -1)
        target = algorithm.learner.loss(batch)["target_value"].unsqueeze(-1)
        terminated = batch["next", "terminated"]
        # A success has nothing to come: its return is its reward.
        returns = torch.where(terminated, batch["next", "reward"], expected)
        assert 0 < terminated.float().mean() < 1
        torch.testing.assert_close(target, returns)


def test_the_first_update_comes_after_the_warm_up_and_with_the_step_that_follows(make_bgpo):
    algorithm = make_bgpo()
    start = [p.detach().clone() for p in weights(algorithm)]
    play(algorithm, algorithm.config.rl.warmup_steps)
    for value, before in zip(weights(algorithm), start, strict=True):
        assert value.equal(before)
    play(algorithm, 1)
    for value, before in zip(weights(algorithm), start, strict=True):
        assert not value.equal(before)
    assert len(algorithm.replay) == algorithm.config.rl.warmup_steps + 1


def test_each_seed_of_a_batch_learns_as_it_would_alone(make_bgpo):
    """Weights and groups; the rows of whole runs, of all kinds, are in ``test_training.py``."""
    seeds = (1, 2)  # no pixel of theirs is so near an edge that rounding moves it across
    close = partial(torch.testing.assert_close, rtol=1e-4, atol=1e-4)
    batch = make_bgpo("all", seeds=seeds, rl="sac", known=15)
    together = play(batch, 45)[0]
    for index, seed in enumerate(seeds):
        alone = make_bgpo("all", seeds=(seed,), rl="sac", known=15)
        data = play(alone, 45)[0][0]
        for key in ("task", "demo_index", "step_count", "group", ("next", "terminated")):
            assert together[index][key].equal(data[key]), key
        for key in ("action", *alone.in_keys, ("next", "reward")):
            close(together[index][key], data[key])
        for ours, theirs in zip(weights(batch), weights(alone), strict=True):
            close(ours[index], theirs[0])
        n_groups, graph = len(alone.groups[0].numbers), alone.gwr.graph(0)
        torch.testing.assert_close(batch.gwr.graph(index), graph, rtol=1e-5, atol=1e-5)
        assert len(graph.weights) > 2
        assert n_groups == len(batch.groups[index].numbers) > 2
        for group in range(n_groups):
            close(batch.actor_weights(index, group), alone.actor_weights(0, group))


def test_what_an_algorithm_lacks_is_refused(make_config, bank, in_world):
    for state in ("latent", "state"):
        config = make_config(state, "without-gwr").algorithm
        with pytest.raises(ValueError, match="needs trained encoders"):
            in_world(BGPO(config, seeds=(0,), bank=bank.seen()), (0,), SCHEDULE)
    config = replace(make_config("state", "oracle").algorithm, demonstration_share=0.25)
    with pytest.raises(ValueError, match="demonstrations are latents"):
        BGPO(config, seeds=(0,), bank=bank.seen())


# ---- the ablations


def test_the_four_variants_of_the_paper_differ_by_transforms_only(make_config, make_bgpo):
    """The same weights, streams, simulations and starts, and transforms of their own."""
    of_each = {
        "bgpo-single": ["BehaviorLookup", "ObservationNorm", "BehaviorMatchingReward"],
        "without-bonus": ["BehaviorLookup", "ObservationNorm"],
        "without-gwr": ["RenameTransform", "ObservationNorm", "BehaviorMatchingReward"],
        "without-both": ["RenameTransform", "ObservationNorm"],
    }
    assert tuple(of_each) == ABLATIONS[:4]
    first = None
    for variant, transforms in of_each.items():
        config = make_config(name=variant).algorithm
        algorithm = make_bgpo(beta=config.beta, context=config.context)
        plain = replace(config, beta=0.1, context="behavior")
        assert plain == make_config(name="bgpo-single").algorithm
        found = [type(transform).__name__ for transform in algorithm.world.env.transform]
        assert found[3:-2] == transforms
        start = algorithm.world.env.reset()
        parts = {key: start[key] for key in ("latent", "task", "demo_index", "demo_embedding")}
        parts |= {key: algorithm.state_dict()[key] for key in ("learner", "noise")}
        parts["world"] = algorithm.world.state_dict()
        first = first or parts
        assert_same(parts, first)
