"""Environments of training and of tests: what an algorithm's policies observe, and their reward."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import one_hot
from torchrl.envs import (
    CatTensors,
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

from bgpo_trl.configs import AlgorithmConfig
from bgpo_trl.encoders.representation import Representation
from bgpo_trl.modules.behavior_groups import BehaviorGroups
from bgpo_trl.modules.gwr import GWRB
from bgpo_trl.scenes import StateColumns
from bgpo_trl.transforms import (
    BehaviorLookup,
    BehaviorMatchingReward,
    DemonstrationSource,
    FrameEncoder,
    GroupLookup,
)


def training_env(
    config: AlgorithmConfig,
    base_env: EnvBase,
    source: DemonstrationSource,
    encoders: Representation | None,
    *,
    state: StateColumns | None = None,
    joints: StateColumns | None = None,
    conditioning: Sequence[Transform] = (),
    beta: float = 0.0,
) -> TransformedEnv:
    """Return the environment of training episodes: simulations ``[S]`` within transforms.

    BGPO has all parts; each ablation and baseline omits some.

    Args:
        config: State and its bound, length of an episode.
        base_env: Simulations.
        source: Draws the task and the demonstration of each episode.
        encoders: Trained encoders; None if neither latents nor the intrinsic reward are used.
        state: Scale of the ground truth; None if policies do not read it.
        joints: Scale of the joints; None if policies do not read them.
        conditioning: Transforms of the demonstration; see `Algorithm`. They are copied.
        beta: Weight of the intrinsic reward; with 0, it is neither added nor measured.

    Raises:
        ValueError: If encoders or the scale of the ground truth are needed and missing.
    """
    transforms: list[Transform] = [
        encode(config, encoders, state),  # pixels -> latent
        StepCounter(config.max_steps, "truncated" if config.timeouts_bootstrap else "terminated"),
        source,  # -> task, demo_embedding
        *(transform.clone() for transform in conditioning),  # -> behavior, group, expert, context
    ]
    if beta:
        if encoders is None:
            raise ValueError("matching behaviors needs trained encoders")
        # reward + beta * exp(-||b - phi_g||)
        transforms.append(BehaviorMatchingReward(encoders.lae, beta))
    transforms += [*beside_joints(joints), *clip(config), RewardSum()]  # episode_reward, ...
    return TransformedEnv(base_env, Compose(transforms))


def conditioning_on(
    context: Literal["behavior", "embedding", "label"] | None,
    *,
    n_tasks: int,
    behavior_scale: float = 1.0,
    gwr: GWRB | None = None,
    groups: Sequence[BehaviorGroups] = (),
    starts: Tensor | None = None,
) -> list[Transform]:
    """Return the transforms by which policies are conditioned on a demonstration.

    Within an environment, GWR-B and groups learn from it when the episode ends. Called on a
    TensorDict, the same transforms only look up.

    Args:
        context: What the policy's ``"context"`` is: the behavior b of ``gwr``, the demonstration's
            embedding phi in its place, the task's label one-hot, or nothing.
        n_tasks: Number of labels.
        behavior_scale: Factor of behavior or embedding in the context. Beside latents of unit
            scale, an unscaled behavior slows the first task down.
        gwr: GWR-B.
        groups: Groups of behaviors of each seed; empty for none.
        starts: First latent of each demonstration, for trials of experts; see `GroupLookup`.
    """
    transforms: list[Transform] = []
    if gwr is not None:
        transforms.append(BehaviorLookup(gwr, learn=True))  # demo_embedding -> behavior
    elif context == "embedding":
        transforms.append(RenameTransform(["demo_embedding"], ["behavior"], create_copy=True))
    if groups:
        transforms.append(GroupLookup(groups, learn=True, starts=starts))  # -> group, expert
    if context == "label":
        label = partial(_label, n_tasks=n_tasks)
        transforms.append(UnaryTransform(["task"], ["context"], fn=label))
    elif context is not None:
        transforms.append(ObservationNorm(0.0, behavior_scale, ["behavior"], ["context"]))
    return transforms


def _label(task: Tensor, n_tasks: int) -> Tensor:
    return one_hot(task, n_tasks).float()


def observation_env(
    config: AlgorithmConfig,
    base_env: EnvBase,
    encoders: Representation | None,
    state: StateColumns | None = None,
    joints: StateColumns | None = None,
) -> TransformedEnv:
    """Return the environment of test episodes, whose policies are already conditioned."""
    observe = [encode(config, encoders, state), *beside_joints(joints), *clip(config)]
    return TransformedEnv(base_env, Compose(observe))


def encode(
    config: AlgorithmConfig, encoders: Representation | None, state: StateColumns | None = None
) -> Transform:
    """Return the transform from the simulation's observation to the state.

    Raises:
        ValueError: If ``config.state`` is ``"latent"`` and ``encoders`` is None, or it is
            ``"state"`` and ``state``, the scale of the ground truth, is None.
    """
    if config.state == "latent":
        if encoders is None:
            raise ValueError("state='latent' needs trained encoders")
        return FrameEncoder(encoders.frame_network, del_keys=True)
    if state is None:
        raise ValueError("state='state' needs a scene with ground truth: learn from frames instead")
    loc, scale = torch.tensor(state.center), torch.tensor(state.scale)
    return ObservationNorm(loc, scale, in_keys=["state"], standard_normal=True)


def beside_joints(joints: StateColumns | None) -> list[Transform]:
    """Return the transforms that put scaled joints beside the latent, or none.

    Reads ``"latent"`` and ``"joints"``; writes ``"latent_and_joints"``. The latent stays as it is,
    since demonstrations are embedded without joints.
    """
    if joints is None:
        return []
    loc, scale = torch.tensor(joints.center), torch.tensor(joints.scale)
    return [
        ObservationNorm(loc, scale, ["joints"], ["scaled_joints"], standard_normal=True),
        CatTensors(["latent", "scaled_joints"], "latent_and_joints", del_keys=False, sort=False),
    ]


def clip(config: AlgorithmConfig) -> list[Transform]:
    """Return the transform that bounds the observed state to ``config.state_limit``, or none.

    An object knocked off the table is dozens of deviations away and would dominate. Clip after
    `BehaviorMatchingReward`, since demonstrations are embedded without clipping.
    """
    limit = config.state_limit
    return [] if limit is None else [ClipTransform([config.observed], low=-limit, high=limit)]
