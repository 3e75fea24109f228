"""BGPO as a whole: what it sees, what it learns from, and that seeds share nothing."""

from copy import deepcopy
from dataclasses import replace

import pytest
import torch
from torchrl.envs import check_env_specs

from bgpo_trl.algorithms import ABLATIONS
from bgpo_trl.algorithms.bgpo import BGPO
from bgpo_trl.transforms import BehaviorLookup, GroupLookup, TaskSchedule
from tests.algorithms.playing import (
    CHANGES,
    SCHEDULE,
    VARIANTS,
    assert_same,
    choice,
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
    actor = algorithm.learner.loss.actor_network
    critic = algorithm.learner.loss.value_network
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
    if told == "label":
        assert start["context"].equal(torch.eye(3)[start["task"]])
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


def act_by_hand(weights, x):
    """The action of a policy of test episodes, from its weights."""
    if "only_clone" not in weights:
        return perceptron(weights, x).tanh()
    actor, clone, critics = (
        {key.removeprefix(part): v for key, v in weights.items() if key.startswith(part)}
        for part in ("actor.", "clone.", "critic.")
    )
    each = [{key: value[number] for key, value in critics.items()} for number in range(5)]
    return choice(actor, clone, each, x, bool(weights["only_clone"]))


@pytest.mark.parametrize("variant", ["experts", "all"])
def test_test_episodes_are_played_by_the_expert_of_their_demonstration(make_bgpo, bank, variant):
    """By hand: the group of each demonstration, its expert's weights, what they do."""
    algorithm = make_bgpo(variant, schedule=TaskSchedule((0, 0, 0)), known=15)
    play(algorithm, 60)
    proposals, groups = algorithm.proposals, algorithm.groups[0].numbers
    if proposals is not None:
        assert all(proposals.clone_is_better(0, group) for group in groups)
        for _ in range(60):  # in one group, what critics choose succeeds, and the clone does not
            alone = proposals.begin(0, groups[0])
            proposals.end(0, not alone, group=groups[0])
        worse = {group: proposals.clone_is_better(0, group) for group in groups}
        assert worse == {group: group != groups[0] for group in groups}
    assert all(len(groups.numbers) > 2 for groups in algorithm.groups)
    shown = bank.held_out()
    embedding, task = shown.embedding.view(3, 4, 32), shown.task.view(3, 4)
    state = torch.randn(2, 3, 4, 64, generator=torch.Generator().manual_seed(0))
    before = deepcopy(algorithm.state_dict())
    policies = [algorithm.snapshot(seed, embedding, task, torch.Generator()) for seed in range(2)]
    acted = zip(policies, state, strict=True)
    actions = torch.stack([policy.act(of_seed) for policy, of_seed in acted])
    assert_same(algorithm.state_dict(), before)
    groups = torch.stack([of_seed.lookup(embedding).group for of_seed in algorithm.groups])
    behaviors = algorithm.gwr.lookup(embedding.expand(2, 3, 4, 32)).embedding
    assert all(len(of_seed.unique()) > 1 for of_seed in groups)
    for seed, t, m in torch.cartesian_prod(*map(torch.arange, groups.shape)).tolist():
        network = algorithm.actor_weights(seed, int(groups[seed, t, m]))
        x = torch.cat([state[seed, t, m], 0.25 * behaviors[seed, t, m]])
        torch.testing.assert_close(actions[seed, t, m], act_by_hand(network, x))


@pytest.mark.parametrize(
    ("variant", "changes", "highest"),
    [
        # A success now, or a time-out with its bonus and a success after it, gamma as much worth.
        ("all", {}, 0.1 + 0.98 * 1.1),
        ("latent, phi", {"beta": 0.3}, 0.3 + 0.95 * 1.3),
        ("latent, b", {"beta": 0.0}, 1.0),
        ("latent, nothing", {"beta": 0.3}, 1.0),
        ("latent, phi", {"timeouts_bootstrap": False}, 1.1),
    ],
)
def test_targets_are_clipped_to_the_attainable_returns(make_bgpo, variant, changes, highest):
    bounds = make_bgpo(variant, **changes).learner.loss.return_bounds
    assert bounds == pytest.approx((0.0, highest))


def test_what_an_algorithm_lacks_is_refused(make_config, bank, in_world):
    config = make_config(name="without-gwr").algorithm
    with pytest.raises(ValueError, match="needs trained encoders"):
        in_world(BGPO(config, seeds=(0,), bank=bank.seen()), SCHEDULE)
    config = replace(make_config("state", "oracle").algorithm, demonstration_share=0.25)
    with pytest.raises(ValueError, match="demonstrations are latents"):
        BGPO(config, seeds=(0,), bank=bank.seen())
    with pytest.raises(ValueError, match="beta must be 0 with the ground truth"):
        replace(make_config(name="without-gwr").algorithm, state="state")
    with pytest.raises(ValueError, match="demonstration_share must be above 0 for a policy"):
        replace(make_config().algorithm, demonstration_share=0.0)


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
