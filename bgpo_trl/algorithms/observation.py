"""Transforms turn frames, ground truth and joints into what policies observe."""

from __future__ import annotations

import torch
from torchrl.envs import CatTensors, ClipTransform, ObservationNorm, Transform

from bgpo_trl.configs import AlgorithmConfig
from bgpo_trl.encoders.representation import Representation
from bgpo_trl.scenes import Scene, StateColumns
from bgpo_trl.transforms import FrameEncoder


def observed_size(config: AlgorithmConfig, scene: Scene, encoders: Representation | None) -> int:
    """Return the number of features that policies observe in a scene.

    Raises:
        ValueError: If the scene lacks the ground truth or the joints that they are to read, or
            there are no encoders for latents.
    """
    if config.state == "state":
        if scene.state is None:
            raise ValueError(
                f"the scene {scene.name!r} has no ground truth: learn from frames, with "
                "state='latent'"
            )
        size = scene.state.size
    elif encoders is None:
        raise ValueError("state='latent' needs trained encoders")
    else:
        size = encoders.frame_network.latent_size
    if not config.joints:
        return size
    if scene.joints is None:
        raise ValueError(
            f"the scene {scene.name!r} has no joints for policies to read: set joints to "
            "False, or give it Scene.joints and its simulation joints() (docs/extending.md)"
        )
    return size + scene.joints.size


def encode(
    config: AlgorithmConfig, encoders: Representation | None, state: StateColumns | None = None
) -> Transform:
    """Return the transform from the simulation's observation to the state.

    ``encoders`` serve latents; ``state``, the scale of the ground truth, serves ground truth.
    """
    if config.state == "latent":
        assert encoders is not None
        return FrameEncoder(encoders.frame_network, del_keys=True)
    assert state is not None
    loc, scale = torch.tensor(state.center), torch.tensor(state.scale)
    return ObservationNorm(loc, scale, in_keys=["state"], standard_normal=True)


def bound(config: AlgorithmConfig, joints: StateColumns | None = None) -> list[Transform]:
    """Return the transforms from the state to what policies read, ``config.observed``.

    Scaled ``joints``, if given, are put beside the latent: this reads ``"latent"`` and
    ``"joints"``, and writes ``"latent_and_joints"``. Then ``config.state_limit`` bounds all: an
    object knocked off the table is dozens of deviations away and would dominate. Demonstrations are
    embedded without joints and bounds, so the latent stays as it is beside joints, and bounds come
    after `BehaviorMatchingReward`.
    """
    transforms = list[Transform]()
    if joints is not None:
        loc, scale = torch.tensor(joints.center), torch.tensor(joints.scale)
        transforms += [
            ObservationNorm(loc, scale, ["joints"], ["scaled_joints"], standard_normal=True),
            CatTensors(
                ["latent", "scaled_joints"], "latent_and_joints", del_keys=False, sort=False
            ),
        ]
    if (limit := config.state_limit) is not None:
        transforms.append(ClipTransform([config.observed], low=-limit, high=limit))
    return transforms
