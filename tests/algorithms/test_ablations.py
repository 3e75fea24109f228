"""The ablations: variants of BGPO that differ by what their transforms write and nothing else."""

from dataclasses import replace

import pytest
import torch
from torchrl.envs import check_env_specs

from bgpo_trl.algorithms import ABLATIONS, ALGORITHMS
from bgpo_trl.algorithms.bgpo import BGPO
from bgpo_trl.configs.rl import DDPGConfig
from bgpo_trl.transforms import BehaviorLookup, GroupLookup, TaskSchedule

pytestmark = pytest.mark.usefixtures("easy_world")
variants = pytest.mark.parametrize("variant", ABLATIONS)


@pytest.fixture
def make(bank, encoders, make_config, in_world):
    def make(variant, **changes):
        config = replace(make_config(name=variant).algorithm, **changes)
        algorithm = BGPO(config, seeds=(3, 8), bank=bank.seen(), encoders=encoders)
        return in_world(algorithm, (3, 8), TaskSchedule((0, 2, 4)))

    return make


def play(algorithm, n_steps):
    """Trains for some steps; returns transitions [S, T]."""
    state, transitions = algorithm.world.env.reset(), []
    for _ in range(n_steps):
        state = algorithm.act(state)
        algorithm.update()
        transition, state = algorithm.world.env.step_and_maybe_reset(state)
        transitions.append(transition.clone())
        algorithm.store(transition)
    return torch.stack(transitions, dim=1)


def assert_same(first, second, where):
    """Compares nested containers bit for bit."""
    if isinstance(first, dict):
        assert list(first) == list(second), where
        for key in first:
            assert_same(first[key], second[key], f"{where}/{key}")
    elif isinstance(first, list | tuple):
        for index, pair in enumerate(zip(first, second, strict=True)):
            assert_same(*pair, f"{where}/{index}")
    elif isinstance(first, torch.Tensor):
        assert first.equal(second), where
    else:
        assert first == second, where


def has_gwr(variant):
    return variant not in ("without-gwr", "without-both")


def has_reward(variant):
    return variant not in ("without-bonus", "without-both")


def has_groups(variant):
    return variant in ("group-balanced-replay", "bgpo-experts", "bgpo")


COMMON = {
    *("latent", "step_count", "task", "demo_embedding", "demo_index", "behavior", "context"),
    *("episode_reward", "success", "done", "terminated", "truncated"),
}
FROM_GWR = {"behavior_node"}
FROM_GROUPS = {"group", "group_novelty"}
FROM_REWARD = {"lae_h", "lae_c", "episode_extrinsic_reward", "episode_intrinsic_reward"}


@variants
def test_a_variant_writes_the_entries_of_its_transforms_and_no_others(make, variant):
    algorithm = make(variant)
    for transform in algorithm.world.env.transform:
        if isinstance(transform, BehaviorLookup | GroupLookup):
            transform.learn = False
    check_env_specs(algorithm.world.env)
    start = algorithm.act(algorithm.world.env.reset())
    expected = COMMON | (FROM_GWR if has_gwr(variant) else set())
    expected |= FROM_REWARD if has_reward(variant) else set()
    expected |= FROM_GROUPS if has_groups(variant) else set()
    assert set(start.keys()) == expected | {"action"}
    following = algorithm.world.env.step(start)["next"]
    rewards = {"extrinsic_reward", "intrinsic_reward"} if has_reward(variant) else set()
    assert set(following.keys()) == expected | {"reward"} | rewards


@variants
def test_the_behavior_is_that_of_gwr_or_the_demonstration_itself(make, bank, variant):
    algorithm, seen, held_out = make(variant), bank.seen().embedding, bank.held_out()
    data = play(algorithm, 50 if has_gwr(variant) else 15)
    phi = data["demo_embedding"]
    assert phi.equal(seen[data["demo_index"]])
    assert data["behavior"].equal(phi) == (not has_gwr(variant))

    shown = held_out.embedding.view(3, 4, 32)
    for index in range(2):
        task = held_out.task.view(3, 4)
        context = algorithm.snapshot(index, shown, task, torch.Generator()).context
        known = shown
        if has_gwr(variant):
            looked_up = algorithm.gwr.lookup(shown.expand(2, 3, 4, 32)).embedding
            known = looked_up[index]
            nodes = algorithm.gwr.graph(index).weights
            distances = (shown.reshape(-1, 1, 32) - nodes).norm(dim=-1)
            assert known.reshape(-1, 32).equal(nodes[distances.argmin(-1)])
        assert context.equal(0.25 * known)
    if has_gwr(variant):
        assert (algorithm.gwr.num_nodes > 2).all()
    else:
        assert algorithm.gwr is None


@variants
def test_the_reward_has_the_bonus_in_variants_with_it_alone(make, encoders, variant):
    data = play(make(variant, beta=0.3 * has_reward(variant)), 30)
    ended, reward = data["next", "done"], data["next", "reward"]
    extrinsic = data["next", "terminated"].float()
    if not has_reward(variant):
        assert reward.equal(extrinsic)
        return
    assert data["next", "extrinsic_reward"].equal(extrinsic)
    n_ended = 0
    for row in data:
        trajectory = []
        for step in row:
            trajectory.append(step["latent"])
            expected = step["next", "terminated"].float()
            if step["next", "done"]:
                trajectory.append(step["next", "latent"])
                length = torch.tensor([len(trajectory)])
                phi_g = encoders.lae.encode(torch.stack(trajectory)[None], length)[0]
                expected = expected + 0.3 * torch.exp(-(step["behavior"] - phi_g).norm())
                trajectory, n_ended = [], n_ended + 1
            torch.testing.assert_close(step["next", "reward"], expected)
    assert n_ended == ended.sum() > 4


@pytest.mark.parametrize("beta", [0.1, 0.3])
@variants
def test_targets_are_bounded_by_the_attainable_return(make, variant, beta):
    success = 1 + beta if has_reward(variant) else 1.0
    # A success now, or after a time-out with a bonus.
    highest = max(success, beta + 0.95 * success) if has_reward(variant) else 1.0
    low, high = make(variant, beta=beta * has_reward(variant)).learner.loss.return_bounds
    assert (low, high) == (0.0, pytest.approx(highest))


def test_the_four_variants_of_the_paper_differ_by_transforms_only(make):
    algorithms = {variant: make(variant) for variant in ABLATIONS[:4]}
    starts = {variant: algorithm.world.env.reset() for variant, algorithm in algorithms.items()}
    reference, start = algorithms["without-both"], starts["without-both"]
    transforms = [type(transform).__name__ for transform in reference.world.env.transform]
    assert transforms == [
        *("FrameEncoder", "StepCounter", "DemonstrationSource"),
        *("RenameTransform", "ObservationNorm", "ClipTransform", "RewardSum"),
    ]
    for variant, algorithm in algorithms.items():
        same = {"context": None, "beta": 0.0}
        assert replace(algorithm.config, **same) == replace(reference.config, **same)
        assert algorithm.in_keys == ["latent", "context"]
        for key, value in algorithm.learner.loss.state_dict().items():
            assert value.equal(reference.learner.loss.state_dict()[key]), key
        for kind in ("learner", "noise"):
            assert_same(algorithm.state_dict()[kind], reference.state_dict()[kind], kind)
        assert_same(algorithm.world.state_dict(), reference.world.state_dict(), "world")
        for key in ("latent", "task", "demo_index", "demo_embedding"):
            assert starts[variant][key].equal(start[key])

        expected = list(transforms)
        if has_gwr(variant):
            expected[expected.index("RenameTransform")] = "BehaviorLookup"
        if has_reward(variant):
            expected.insert(-3, "BehaviorMatchingReward")
        assert [type(transform).__name__ for transform in algorithm.world.env.transform] == expected


def test_the_variants_beyond_the_paper_add_one_thing_at_a_time(make):
    published = ALGORITHMS["bgpo-single"].config
    assert not (
        published.experts or published.group_balanced_replay or published.demonstration_share
    )
    slow = DDPGConfig(noise=0.1, update_every=4)
    alone = {"demonstration_share": 0.75, "rl": replace(slow, batch_size=384)}
    shown = {**alone, "rl": slow, "expert_batch_size": 128}
    for variant, added in {
        "group-balanced-replay": {"group_balanced_replay": True},
        "bgpo-experts": {"group_balanced_replay": True, "experts": True},
        "demonstrations": alone,
        "bgpo": {"group_balanced_replay": True, "experts": True, **shown},
    }.items():
        assert ALGORITHMS[variant].config == replace(published, **added)
        algorithm = make(variant)
        assert (algorithm.groups is not None) == has_groups(variant)
        assert (algorithm.shown is not None) == (variant in ("demonstrations", "bgpo"))
