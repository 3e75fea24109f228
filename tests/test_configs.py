"""Hyperparameters without a meaning are refused where they are made."""

import math
from contextlib import nullcontext
from dataclasses import asdict

import numpy as np
import pytest
import torch

from bgpo_trl.configs import (
    AlgorithmConfig,
    BGPOConfig,
    DistNLLConfig,
    FineTuningConfig,
    GWRBConfig,
    MAMLConfig,
    RepresentationConfig,
    RLConfig,
    RunConfig,
    SequenceAutoencoderConfig,
    VAEConfig,
)

NAN = math.nan
BAD = {
    VAEConfig: {"batch_size": 0, "window": 3, "learning_rate": -1e-3, "kl_weight": NAN},
    SequenceAutoencoderConfig: {"steps": 0, "warmup_steps": 0},
    RepresentationConfig: {"seed": -1, "log_every": 0},
    RLConfig: {
        "hidden_sizes": (64, 0),
        "batch_size": 1.5,
        "learning_rate": math.inf,
        "gamma": NAN,
        "tau": 0.0,
        "noise": -0.1,
        "warmup_steps": 0,
        "replay_size": 100,
        "critics": 0,
        "n_steps": 0,
        "policy_delay": 0,
        "clone_share": 1.0,
        "success_share": 0.5,
    },
    AlgorithmConfig: {"state": "pixels", "max_steps": 0, "demonstration_share": 1.0},
    GWRBConfig: {
        "activity_scale": 0.0,
        "activity_threshold": 1.1,
        "habituation_threshold": NAN,
        "lr_best": 0.001,
        "lr_neighbor": -0.1,
        "initial_habituation": 0.0,
        "alpha_best": 0.5,
        "alpha_neighbor": 0.5,
        "tau_neighbor": math.inf,
        "max_age": 0,
    },
    BGPOConfig: {
        "state_limit": 0.0,
        "group_balanced_replay": False,
        "group_size": 3,
        "group_evidence": 0.0,
        "rest_after": 0,
        "active_groups": 0,
        "behavior_scale": 0.0,
        "beta": NAN,
        "demonstration_share": 0.999,
    },
    # Of a balanced replay, nothing is forgotten.
    FineTuningConfig: {"experts": True, "group_balanced_replay": True},
    MAMLConfig: {"inner_learning_rate": NAN, "task_batch_size": 7, "demonstration_share": 0.999},
    DistNLLConfig: {
        "learning_rate": NAN,
        "task_batch_size": 0,
        "distillation_batch_size": 0,
        "demonstration_share": 0.999,
    },
    RunConfig: {
        "seeds": (0.5,),
        "episodes": 1e4,
        "held_out": "training",
        "schedule": "cumulative",
        "eval_episodes": -1,
        "checkpoint_minutes": NAN,
        "task_starts": (100, 200, 300),
    },
}
CASES = [(config, *value) for config, values in BAD.items() for value in values.items()]
CASES += [(RunConfig, "task_starts", starts) for starts in ((), (0, -1, 300), (0, 0.5, 1), (0, 1))]
CASES.append((VAEConfig, "window", 1))
OF_ANOTHER_TYPE = {"episodes": True, "seeds": 3, "tasks": "grasp", "spread": "1", "algorithm": 5}
CASES += [(RunConfig, *value) for value in OF_ANOTHER_TYPE.items()]


@pytest.mark.parametrize(
    ("config", "name", "value"), CASES, ids=[f"{c.__name__}-{n}" for c, n, _ in CASES]
)
def test_a_bad_value_is_refused_with_the_name_of_its_field(refused, config, name, value):
    refused(lambda: config(**{name: value}), f"{name} must be ", f"got {value}")


@pytest.mark.parametrize("seeds", [(), (1, 1), (-1,)])
def test_seeds_differ_and_none_is_negative(seeds):
    with pytest.raises(ValueError, match="seeds must be "):
        RunConfig(seeds=seeds)


def test_numbers_and_sequences_of_other_libraries_become_plain():
    rl = RLConfig(
        hidden_sizes=np.array([5, 7]), gamma=np.float64(0.5), clip_targets=np.bool_(False)
    )
    label = np.str_("label")
    of_rl = BGPOConfig(rl=rl, max_steps=torch.tensor(9), beta=np.int64(0), context=label)
    few = {"seeds": range(2), "episodes": np.int32(7), "task_starts": np.zeros(1, int)}
    given = RunConfig(**few, tasks=["grasp"], algorithm=of_rl)
    rl = RLConfig(hidden_sizes=(5, 7), gamma=0.5, clip_targets=False)
    of_rl = BGPOConfig(rl=rl, max_steps=9, beta=0.0, context="label")
    few = {"seeds": (0, 1), "episodes": 7, "task_starts": (0,)}
    assert repr(given) == repr(RunConfig(**few, tasks=("grasp",), algorithm=of_rl))


def test_seeds_learn_from_demonstrations_after_an_episode_of_their_own():
    with pytest.raises(ValueError, match=r"warmup_steps \(49\) must be at least max_steps"):
        BGPOConfig(rl=RLConfig(warmup_steps=49))
    BGPOConfig(rl=RLConfig(warmup_steps=49), experts=False, demonstration_share=0.0)


@pytest.mark.parametrize(
    ("config", "name"),
    [(MAMLConfig, "share_batch"), (MAMLConfig, "adapt_to_latest"), (DistNLLConfig, "share_batch")],
)
def test_what_the_paper_has_does_not_mix_with_demonstrations_as_experience(config, name):
    with pytest.raises(ValueError, match=f"{name} must be off with demonstrations"):
        config(demonstration_share=0.75, **{name: True})


@pytest.mark.parametrize("name", ["demonstration_pace", "demonstration_noise"])
def test_how_to_imitate_is_refused_where_nothing_is_imitated(name):
    with pytest.raises(ValueError, match=rf"{name} must be left out where .* is 0.*, got 0\.5"):
        BGPOConfig(experts=False, demonstration_share=0.0, rl=RLConfig(), **{name: 0.5})


def test_config_files_hold_every_number_that_acts():
    assert None not in asdict(RunConfig()).values()
    of_bank = {"demonstration_noise"}  # whose digest the run holds
    assert {name for name, value in asdict(BGPOConfig()).items() if value is None} == of_bank


@pytest.mark.parametrize(
    ("critics", "policy_delay", "missed"),
    [(4, 1, False), (3, 2, False), (5, 2, False), (4, 2, True), (3, 3, True), (10, 9, True)],
)
def test_a_critic_that_the_actor_would_never_see_is_refused(critics, policy_delay, missed):
    with (
        pytest.raises(ValueError, match="critics must be a number of which")
        if missed
        else (nullcontext())
    ):
        RLConfig(critics=critics, policy_delay=policy_delay)
