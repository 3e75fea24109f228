"""`examples/bgpo_minimal.py` computes what the library's `bgpo-single` computes, step by step."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from bgpo_trl.algorithms import entry
from bgpo_trl.configs import RunConfig
from tests.helpers import spied

EXAMPLE = Path(__file__).parents[1] / "examples" / "bgpo_minimal.py"
OF_RL = ("hidden_sizes", "batch_size", "replay_size", "warmup_steps")
STORED = {  # entries of the example's replay, by their keys in the library
    "latent": "latent",
    "behavior": "behavior",
    "action": "action",
    "reward": ("next", "reward"),
    "next_latent": ("next", "latent"),
    "terminated": ("next", "terminated"),
}


@pytest.fixture(scope="module")
def example(easy_world):
    spec = importlib.util.spec_from_file_location("bgpo_minimal", EXAMPLE)
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.NicoEnv = easy_world
    yield module
    del sys.modules[spec.name]


@pytest.fixture(scope="module")
def small(example):
    """Settings in which a hundred steps fill the replay, grow GWR-B and clip states and targets."""
    return example.Settings(
        seed=3,
        episodes=50,
        task_starts=(0, 12, 24),
        test_every=10,
        test_episodes=2,
        max_steps=4,
        state_limit=0.01,
        activity_scale=4.0,
        hidden_sizes=(32, 16),
        batch_size=16,
        replay_size=60,
        warmup_steps=20,
    )


@pytest.fixture(scope="module")
def minimal(example, small, encoders, bank):
    """The example after training, with its calls of these methods."""
    bgpo = example.MinimalBGPO(small, encoders, bank)
    bgpo.calls = {name: spied(bgpo, name) for name in ("store", "update", "inputs", "test")}
    bgpo.train()
    return bgpo


@pytest.fixture(scope="module")
def library(small, begin, tmp_path_factory):
    """A run of `bgpo-single` with the same settings, and its transitions and evaluations."""
    defaults = entry("bgpo-single").config
    config = replace(
        defaults,
        max_steps=small.max_steps,
        state_limit=small.state_limit,
        gwr=replace(defaults.gwr, activity_scale=small.activity_scale),
        rl=replace(defaults.rl, **{name: getattr(small, name) for name in OF_RL}),
    )
    run = RunConfig(
        seeds=(small.seed,),
        episodes=small.episodes,
        task_starts=small.task_starts,
        eval_every=small.test_every,
        eval_episodes=small.test_episodes,
        name="bgpo-single",
        algorithm=config,
    )
    with begin(tmp_path_factory.mktemp("library"), run) as trainer:
        stored, tested = spied(trainer.algorithm, "store"), spied(trainer.evaluator, "run")
        trainer.run()
    return trainer.algorithm, stored, tested


def assert_close(ours, theirs, atol=1e-6):
    torch.testing.assert_close(ours, theirs, rtol=1e-6, atol=atol)


def test_defaults_are_those_of_bgpo_single(example):
    settings, config = example.Settings(), entry("bgpo-single").config
    for name in ("max_steps", "beta", "behavior_scale", "state_limit"):
        assert getattr(settings, name) == getattr(config, name), name
    for name in ("learning_rate", "noise", "gamma", "tau", "pre_tanh_penalty", *OF_RL):
        assert getattr(settings, name) == getattr(config.rl, name), name
    assert settings.activity_scale == config.gwr.activity_scale


def test_transitions_are_those_of_the_library(minimal, library, small):
    ours = torch.stack([arguments[0] for arguments, _ in minimal.calls["store"]])
    theirs = torch.cat([arguments[0] for arguments, _ in library[1]])
    assert len(ours) == len(theirs) > 100
    for key in STORED.values():
        # Actions that differ by rounding can change a pixel by one of its 255 levels.
        assert_close(ours[key], theirs[key], atol=2e-5)
    clipped = ours["latent"].abs() == torch.tensor(small.state_limit)
    assert 0 < clipped.float().mean() < 1
    assert ours["next", "terminated"].any()
    assert (ours["next", "done"] & ~ours["next", "terminated"]).any()  # time-outs
    for name, key in STORED.items():  # the latest are in the ring, in the order of time
        held = minimal.replay.rows[name].roll(-len(ours), 0)
        assert held.equal(ours[key][-len(held) :].view_as(held))


@pytest.mark.parametrize("network", ["actor", "critic", "target_actor", "target_critic"])
def test_weights_are_those_of_the_library(minimal, library, network):
    """Hence also the losses of all updates."""
    assert len(minimal.calls["update"]) > 80
    name = network.replace("actor", "actor_network").replace("critic", "value_network")
    theirs = library[0].learner.loss.get_submodule(f"{name}_params")
    theirs = dict(theirs.flatten_keys(".").items())
    linear = [layer for layer in getattr(minimal, network) if isinstance(layer, torch.nn.Linear)]
    assert len(theirs) == 2 * len(linear)
    for number, layer in enumerate(linear):
        assert_close(layer.weight.T, theirs[f"mlp.layers.{number}.weight"][0, 0])
        assert_close(layer.bias, theirs[f"mlp.layers.{number}.bias"][0, 0])


def test_behaviors_are_those_of_the_library(minimal, library):
    ours, theirs = minimal.gwr.graph(), library[0].gwr.graph(0)
    assert len(ours.node) > 4
    for mine, other in zip(ours, theirs, strict=True):
        assert mine.equal(other)


def test_tests_are_those_of_the_library(minimal, library, small):
    results = [result for _, result in library[2]]
    inputs = [given for given, _ in minimal.calls["inputs"] if given[0].ndim == 3]  # of tests
    assert max(latent.abs().max() for latent, _ in inputs) <= torch.tensor(small.state_limit)
    contexts = torch.stack([result.snapshots[0].policy.context for result in results])
    behaviors = torch.stack([behavior for _, behavior in inputs[:: small.max_steps]])
    assert_close(small.behavior_scale * behaviors, contexts)

    ours = torch.tensor([[*rates.values()] for _, rates in minimal.calls["test"]])
    theirs = torch.stack([result.success[0].float().mean(-1) for result in results])
    presented = torch.stack([result.snapshots[0].presented for result in results])
    assert_close(ours[presented], theirs[presented])
    assert 0 < ours[presented].mean() < 1
