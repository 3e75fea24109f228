"""The ablation: variants of BGPO that differ by what their transforms write and nothing else."""

import json
import sys
from dataclasses import fields, replace
from pathlib import Path
from typing import get_args, get_type_hints

import pytest
import torch
from torchrl.envs import check_env_specs

from benchmarks import ablation
from bgpo_trl.algorithms import ABLATIONS
from bgpo_trl.algorithms.bgpo import BGPO
from bgpo_trl.configs.rl import DDPGConfig
from bgpo_trl.experiments.arguments import Arguments, command_line
from bgpo_trl.files.checkpoint import load_checkpoint
from bgpo_trl.runs.results import read_table
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
    return variant not in ("r_int", "none")


def has_reward(variant):
    return variant not in ("gwr", "none")


def has_groups(variant):
    return variant in ("even-replay", "experts", "all")


COMMON = {
    *("latent", "step_count", "task", "demo_embedding", "demo_index", "behavior", "context"),
    *("episode_reward", "done", "terminated", "truncated"),
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
def test_only_what_is_paid_for_is_in_the_reward(make, encoders, variant):
    data = play(make(variant, beta=0.3), 30)
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
def test_targets_are_bounded_by_what_can_be_earned(make, variant, beta):
    success = 1 + beta if has_reward(variant) else 1.0
    # Now, or after a time-out that was paid for.
    highest = max(success, beta + 0.95 * success) if has_reward(variant) else 1.0
    low, high = make(variant, beta=beta).learner.loss.return_bounds
    assert (low, high) == (0.0, pytest.approx(highest))


def test_the_variant_with_both_is_bgpo_bit_for_bit(make):
    bgpo, variant = make("bgpo-single"), make("gwr+r_int")
    ours, theirs = play(bgpo, 30), play(variant, 30)
    assert set(ours.keys(True, True)) == set(theirs.keys(True, True))
    assert (ours == theirs).all()
    start = make("bgpo-single").learner.loss.state_dict()
    for key, value in bgpo.learner.loss.state_dict().items():
        assert value.equal(variant.learner.loss.state_dict()[key]), key
        if "target_" not in key and key.endswith("weight"):
            assert not value.equal(start[key]), key
    for index in range(2):
        for mine, other in zip(bgpo.gwr.graph(index), variant.gwr.graph(index), strict=True):
            assert mine.equal(other)


def test_variants_differ_by_transforms_only(make):
    """The paper's four."""
    paper = ("gwr+r_int", "gwr", "r_int", "none")
    algorithms = {variant: make(variant) for variant in paper}
    starts = {variant: algorithm.world.env.reset() for variant, algorithm in algorithms.items()}
    reference, start = algorithms["none"], starts["none"]
    transforms = [type(transform).__name__ for transform in reference.world.env.transform]
    assert transforms == [
        *("FrameEncoder", "StepCounter", "DemonstrationSource"),
        *("RenameTransform", "ObservationNorm", "ClipTransform", "RewardSum"),
    ]
    for variant, algorithm in algorithms.items():
        assert replace(algorithm.config, variant="") == replace(reference.config, variant="")
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


def test_the_command_line_knows_every_variant():
    choices = get_type_hints(ablation.Arguments)["variant"]
    assert set(get_args(choices)) == set(ABLATIONS)
    assert ablation.Arguments().variant == "gwr+r_int"
    own = {field.name for field in fields(ablation.Arguments)}
    assert own - {field.name for field in fields(Arguments)} == {"variant", "continual"}


def test_the_variants_beyond_the_paper_add_one_thing_at_a_time(make):
    published = ABLATIONS["gwr+r_int"].config
    assert not (published.experts or published.even_replay or published.demonstration_share)
    alone = {"demonstration_share": 0.75, "rl": DDPGConfig(noise=0.1, batch_size=384)}
    shown = {**alone, "rl": DDPGConfig(noise=0.1), "expert_batch_size": 128}
    for variant, added in {
        "even-replay": {"variant": "bgpo", "even_replay": True},
        "experts": {"variant": "bgpo", "even_replay": True, "experts": True},
        "demonstrations": alone,
        "all": {
            "variant": "bgpo",
            "even_replay": True,
            "experts": True,
            **shown,
        },
    }.items():
        assert ABLATIONS[variant].config == replace(published, **added)
        algorithm = make(variant)
        assert (algorithm.groups is not None) == has_groups(variant)
        assert (algorithm.shown is not None) == (variant in ("demonstrations", "all"))


@variants
def test_the_command_line_runs_a_variant_under_its_name(
    tiniest, monkeypatch, tmp_path, capsys, variant
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["ablation.py", "--variant", variant])
    command_line(ablation.main, "", ablation.Arguments)
    run = Path("runs") / f"ablation-{variant}-quick"
    assert f"curve and figures: {run}" in capsys.readouterr().out
    config = json.loads((run / "config.json").read_text())
    assert (config["name"], config["task_starts"]) == (variant, [0, 0, 0])
    for file in ("train.csv", "eval.csv"):
        assert set(read_table(run / file)["algorithm"]) == {variant}
    train = read_table(run / "train.csv")
    assert ((train["num_nodes"].astype(int) > 1) == has_gwr(variant)).all()
    assert ((train["intrinsic_return"].astype(float) > 0) == has_reward(variant)).all()
    learner = load_checkpoint(run / "checkpoint")["algorithm"]
    assert ("gwr" in learner) == has_gwr(variant)
    assert ("groups" in learner) == has_groups(variant)
    assert (run / "figures" / "gwr.png").exists() == has_gwr(variant)


def test_another_algorithm_has_no_variants(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["ablation.py", "--algorithm", "maml"])
    with pytest.raises(SystemExit) as ended:
        command_line(ablation.main, "", ablation.Arguments)
    assert ended.value.code == "error: --algorithm: the variants are BGPO's"
    assert not list(tmp_path.iterdir())
