"""Settings without a meaning are refused where they are made; see `test_bad_input.py`."""

import inspect
import math
from dataclasses import asdict

import pytest

from bgpo_trl.configs import (
    AlgorithmConfig,
    BGPOConfig,
    DDPGConfig,
    DistNLLConfig,
    GWRBConfig,
    MAMLConfig,
    RepresentationConfig,
    RunConfig,
    SequenceAutoencoderConfig,
    VAEConfig,
)
from bgpo_trl.modules.gwr import GWRB

NAN = math.nan
SETTINGS = [
    (VAEConfig, {"batch_size": 0}, "at least 1"),
    (VAEConfig, {"window": 1}, "at least 2"),
    (VAEConfig, {"window": 3}, "a divisor of batch_size 128"),
    (VAEConfig, {"learning_rate": -1e-3}, "a number above 0"),
    (VAEConfig, {"kl_weight": NAN}, "at least 0"),
    (SequenceAutoencoderConfig, {"steps": 0}, "at least 1"),
    (SequenceAutoencoderConfig, {"warmup_steps": 0}, "at least 1"),
    (RepresentationConfig, {"seed": -1}, "at least 0"),
    (RepresentationConfig, {"log_every": 0}, "at least 1"),
    (DDPGConfig, {"hidden_sizes": ()}, "one or more whole numbers"),
    (DDPGConfig, {"hidden_sizes": (64, 0)}, "one or more whole numbers, of at least 1"),
    (DDPGConfig, {"hidden_sizes": (64.5,)}, "one or more whole numbers"),
    (DDPGConfig, {"batch_size": 1.5}, "a whole number"),
    (DDPGConfig, {"learning_rate": 0.0}, "a number above 0"),
    (DDPGConfig, {"learning_rate": math.inf}, "a number above 0"),
    (DDPGConfig, {"batch_size": 0}, "at least 1"),
    (DDPGConfig, {"gamma": 1.5}, "between 0 and 1"),
    (DDPGConfig, {"gamma": NAN}, "between 0 and 1"),
    (DDPGConfig, {"tau": 0.0}, "above 0 and at most 1"),
    (DDPGConfig, {"tau": 5}, "above 0 and at most 1"),
    (DDPGConfig, {"noise": -0.1}, "at least 0"),
    (DDPGConfig, {"pre_tanh_penalty": NAN}, "at least 0"),
    (DDPGConfig, {"warmup_steps": 0}, "at least 1"),
    (DDPGConfig, {"replay_size": 100}, "256 (batch, warm-up) or more"),
    (AlgorithmConfig, {"state": "pixels"}, "latent or state"),
    (AlgorithmConfig, {"max_steps": 0}, "at least 1"),
    (AlgorithmConfig, {"demonstration_share": 1.0}, "at least 0 and below 1"),
    (AlgorithmConfig, {"demonstration_share": NAN}, "at least 0 and below 1"),
    (
        BGPOConfig,
        {"demonstration_share": 0.99, "expert_batch_size": 8},
        "less, to leave some of 8 transitions",
    ),
    (
        MAMLConfig,
        {"demonstration_share": 0.95, "task_batch_size": 4},
        "less, to leave some of 4 transitions",
    ),
    (DistNLLConfig, {"demonstration_share": 0.999}, "less, to leave some of 64 transitions"),
    (GWRBConfig, {"activity_scale": 0.0}, "a number above 0"),
    (GWRBConfig, {"activity_threshold": 1.0}, "between 0 and 1"),
    (GWRBConfig, {"lr_best": 0.001}, "at least lr_neighbor (0.01), at most 1"),
    (GWRBConfig, {"initial_habituation": 0.0}, "above 0, at most 1"),
    (GWRBConfig, {"alpha_best": 0.5}, "at least 1 / initial_habituation, got 0.5"),
    (GWRBConfig, {"tau_best": 0}, "a number above 0"),
    (GWRBConfig, {"max_age": 0}, "at least 1"),
    (BGPOConfig, {"state_limit": 0.0}, "a number above 0"),
    (BGPOConfig, {"group_size": 3}, "at least 4"),
    (BGPOConfig, {"group_evidence": 0.0}, "a number above 0"),
    (BGPOConfig, {"rest_after": 0}, "at least 1"),
    (RunConfig, {"held_out": "training"}, "validation or test"),
    (RunConfig, {"schedule": "cumulative"}, "practised or sequential"),
    (BGPOConfig, {"active_groups": 0}, "at least 1"),
    (BGPOConfig, {"expert_batch_size": 0}, "at least 1"),
    (BGPOConfig, {"behavior_scale": 0.0}, "a number above 0"),
    (BGPOConfig, {"group_balanced_replay": False}, "set where there are experts"),
    (BGPOConfig, {"beta": -0.1}, "at least 0"),
    (BGPOConfig, {"beta": NAN}, "at least 0"),
    (MAMLConfig, {"inner_learning_rate": NAN}, "at least 0"),
    (MAMLConfig, {"task_batch_size": 7}, "even"),
    (MAMLConfig, {"task_batch_size": 0}, "at least 2"),
    (DistNLLConfig, {"learning_rate": NAN}, "a number above 0"),
    (DistNLLConfig, {"task_batch_size": 0}, "at least 1"),
    (RunConfig, {"episodes": 0}, "at least 1"),
    (RunConfig, {"episodes": 1e4}, "a whole number"),
    (RunConfig, {"seeds": (0.5,)}, "whole numbers"),
    (RunConfig, {"task_starts": (0, 0.5, 1)}, "whole numbers"),
    (RunConfig, {"eval_episodes": -1}, "at least 1"),
    (RunConfig, {"checkpoint_minutes": NAN}, "at least 0"),
    (RunConfig, {"task_starts": ()}, "one episode for each of the tasks"),
    (RunConfig, {"task_starts": (100, 200, 300)}, "at least 0, and one of them 0"),
    (RunConfig, {"task_starts": (0, -1, 300)}, "at least 0, and one of them 0"),
]


@pytest.mark.parametrize(
    ("config", "values", "remedy"), SETTINGS, ids=[f"{c.__name__}-{v}" for c, v, _ in SETTINGS]
)
def test_settings(refused, config, values, remedy):
    (name, value), *_ = values.items()
    refused(lambda: config(**values), f"{name} must be {remedy}", f"got {value}")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"rl": DDPGConfig(warmup_steps=49)}, r"warmup_steps \(49\) must be at least max_steps"),
    ],
)
def test_settings_that_do_not_go_together(settings, message):
    with pytest.raises(ValueError, match=message):
        BGPOConfig(**settings)
    BGPOConfig(**settings, experts=False, demonstration_share=0.0)  # by themselves they do


def test_gwr_b_has_the_settings_of_its_config_and_no_others():
    """So that all that acts is in config.json."""
    fixed = {"n_features", "batch_size", "generator", "init", "max_nodes"}
    defaults = {name: p.default for name, p in inspect.signature(GWRB).parameters.items()}
    chosen = asdict(GWRBConfig())
    assert chosen.keys() == defaults.keys() - fixed
    differing = {name for name, value in chosen.items() if value != defaults[name]}
    assert differing == {"activity_scale"}
    assert None not in asdict(RunConfig()).values()
    assert None not in asdict(BGPOConfig()).values()
