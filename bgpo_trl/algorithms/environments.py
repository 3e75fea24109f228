"""Environments of BGPO and its variants: transforms from frames to latents and ``context``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import one_hot
from torchrl.envs import (
    ClipTransform,
    Compose,
    EnvBase,
    ObservationNorm,
    RenameTransform,
    RewardSum,
    StepCounter,
    Transform,
    TransformedEnv,
    UnaryTransform,
)

from bgpo_trl.configs import AlgorithmConfig, BGPOConfig
from bgpo_trl.encoders.representation import Representation
from bgpo_trl.modules.behavior_groups import BehaviorGroups
from bgpo_trl.modules.gwr import GWRB
from bgpo_trl.transforms import (
    BehaviorLookup,
    BehaviorMatchingReward,
    DemonstrationSource,
    FrameEncoder,
    GroupLookup,
)
from suites.nico.base import STATE_CENTER, STATE_SCALE

__all__ = ["VARIANTS", "Variant"]


def bgpo_env(
    config: BGPOConfig,
    base_env: EnvBase,
    source: DemonstrationSource,
    encoders: Representation | None,
    gwr: GWRB,
    groups: BehaviorGroups,
) -> TransformedEnv:
    """Return the environment of BGPO, in which the inferred group selects the expert."""
    return TransformedEnv(
        base_env,
        Compose(
            [
                encode(config, encoders),  # pixels -> latent
                StepCounter(config.max_steps),
                source,  # -> task, demo_embedding
                BehaviorLookup(gwr, learn=True),  # demo_embedding -> behavior
                GroupLookup(groups, learn=True),  # demo_embedding -> group
                match_behavior(config, encoders),  # reward + beta * exp(-||behavior - phi_g||)
                behavior_as_context(config),  # behavior -> context
                clip(config),
                sum_rewards("reward", "extrinsic_reward", "intrinsic_reward"),
            ]
        ),
    )


def published_env(
    config: BGPOConfig,
    base_env: EnvBase,
    source: DemonstrationSource,
    encoders: Representation | None,
    gwr: GWRB,
    groups: None,
) -> TransformedEnv:
    """Return the environment of BGPO as published (Alg. 1), with one policy for all behaviors."""
    return TransformedEnv(
        base_env,
        Compose(
            [
                encode(config, encoders),
                StepCounter(config.max_steps),
                source,
                BehaviorLookup(gwr, learn=True),
                match_behavior(config, encoders),
                behavior_as_context(config),
                clip(config),
                sum_rewards("reward", "extrinsic_reward", "intrinsic_reward"),
            ]
        ),
    )


def without_bonus_env(
    config: BGPOConfig,
    base_env: EnvBase,
    source: DemonstrationSource,
    encoders: Representation | None,
    gwr: GWRB,
    groups: None,
) -> TransformedEnv:
    """Return the environment of the ablation with GWR-B, without intrinsic reward (Fig. 9)."""
    return TransformedEnv(
        base_env,
        Compose(
            [
                encode(config, encoders),
                StepCounter(config.max_steps),
                source,
                BehaviorLookup(gwr, learn=True),
                behavior_as_context(config),
                clip(config),
                sum_rewards("reward"),
            ]
        ),
    )


def without_gwr_env(
    config: BGPOConfig,
    base_env: EnvBase,
    source: DemonstrationSource,
    encoders: Representation | None,
    gwr: None,
    groups: None,
) -> TransformedEnv:
    """Return the environment of the ablation whose behavior is the demonstration (Fig. 9)."""
    return TransformedEnv(
        base_env,
        Compose(
            [
                encode(config, encoders),
                StepCounter(config.max_steps),
                source,
                RenameTransform(["demo_embedding"], ["behavior"], create_copy=True),
                match_behavior(config, encoders),
                behavior_as_context(config),
                clip(config),
                sum_rewards("reward", "extrinsic_reward", "intrinsic_reward"),
            ]
        ),
    )


def without_both_env(
    config: BGPOConfig,
    base_env: EnvBase,
    source: DemonstrationSource,
    encoders: Representation | None,
    gwr: None,
    groups: None,
) -> TransformedEnv:
    """Return the environment of the ablation without GWR-B and intrinsic reward (Fig. 9)."""
    return TransformedEnv(
        base_env,
        Compose(
            [
                encode(config, encoders),
                StepCounter(config.max_steps),
                source,
                RenameTransform(["demo_embedding"], ["behavior"], create_copy=True),
                behavior_as_context(config),
                clip(config),
                sum_rewards("reward"),
            ]
        ),
    )


def label_env(
    config: BGPOConfig,
    base_env: EnvBase,
    source: DemonstrationSource,
    encoders: Representation | None,
    gwr: None,
    groups: None,
) -> TransformedEnv:
    """Return the environment of DDPG whose context is the one-hot label of the task."""
    n_tasks = source.schedule.n_tasks

    def label(task: Tensor) -> Tensor:
        return one_hot(task, n_tasks).float()

    return TransformedEnv(
        base_env,
        Compose(
            [
                encode(config, encoders),
                StepCounter(config.max_steps),
                source,
                UnaryTransform(["task"], ["context"], fn=label),
                clip(config),
                sum_rewards("reward"),
            ]
        ),
    )


def no_context_env(
    config: AlgorithmConfig,
    base_env: EnvBase,
    source: DemonstrationSource,
    encoders: Representation | None,
    gwr: None = None,
    groups: None = None,
) -> TransformedEnv:
    """Return the environment of MAML, Dist-NLL and plain DDPG, without context."""
    return TransformedEnv(
        base_env,
        Compose(
            [
                encode(config, encoders),
                StepCounter(config.max_steps),
                source,
                clip(config),
                sum_rewards("reward"),
            ]
        ),
    )


def observation_env(
    config: AlgorithmConfig, base_env: EnvBase, encoders: Representation | None
) -> TransformedEnv:
    """Return the environment of test episodes, whose policies are already conditioned."""
    return TransformedEnv(base_env, Compose([encode(config, encoders), clip(config)]))


def encode(config: AlgorithmConfig, encoders: Representation | None) -> Transform:
    """Return the transform from the simulation's observation to the state.

    Raises:
        ValueError: If ``config.state`` is ``"latent"`` and ``encoders`` is None.
    """
    if config.state == "latent":
        if encoders is None:
            raise ValueError("state='latent' needs trained encoders")
        return FrameEncoder(encoders.vae, del_keys=True)
    loc, scale = torch.tensor(STATE_CENTER), torch.tensor(STATE_SCALE)
    return ObservationNorm(loc, scale, in_keys=["state"], standard_normal=True)


def match_behavior(config: BGPOConfig, encoders: Representation | None) -> BehaviorMatchingReward:
    """Return the transform that adds the intrinsic reward.

    Raises:
        ValueError: If ``encoders`` is None.
    """
    if encoders is None:
        raise ValueError("matching behaviors needs trained encoders")
    return BehaviorMatchingReward(encoders.lae, beta=config.beta)


def behavior_as_context(config: BGPOConfig) -> ObservationNorm:
    """Return the transform that scales the behavior to the context.

    Beside latents of unit scale, an unscaled behavior slows the first task down.
    """
    return ObservationNorm(0.0, config.behavior_scale, ["behavior"], ["context"])


def clip(config: AlgorithmConfig) -> ClipTransform:
    """Return the transform that bounds the observed state to ``config.state_limit``.

    An object knocked off the table is dozens of deviations away and would dominate. Clip after
    `BehaviorMatchingReward`, since demonstrations are embedded without clipping.
    """
    return ClipTransform([config.state], low=-config.state_limit, high=config.state_limit)


def sum_rewards(*keys: str) -> RewardSum:
    """Return the transform that sums each reward over the episode, as ``episode_...``."""
    return RewardSum(in_keys=list(keys), out_keys=[f"episode_{key}" for key in keys])


@dataclass(frozen=True)
class Variant:
    """A variant of BGPO: its environment and the modules it needs."""

    make_env: Callable[..., TransformedEnv]
    """Called with a config, the simulation, a `DemonstrationSource`, the encoders, GWR-B and the
    groups of behaviors; the last three may be None."""
    context: Literal["behavior", "label"] | None = "behavior"
    """Meaning of the policy's ``context``; None for no context."""
    gwr: bool = False
    """Whether GWR-B infers the behavior."""
    groups: bool = False
    """Whether behaviors are grouped, as experts and replay balanced by group require."""
    bonus: bool = False
    """Whether the intrinsic reward is added."""


VARIANTS: dict[str, Variant] = {
    "bgpo": Variant(bgpo_env, gwr=True, groups=True, bonus=True),
    "published": Variant(published_env, gwr=True, bonus=True),
    "without-bonus": Variant(without_bonus_env, gwr=True),
    "without-gwr": Variant(without_gwr_env, bonus=True),
    "without-both": Variant(without_both_env),
    "label": Variant(label_env, context="label"),
    "no-context": Variant(no_context_env, context=None),
}
"""Variants by ``BGPOConfig.variant``; a new entry can be trained and its runs loaded."""
