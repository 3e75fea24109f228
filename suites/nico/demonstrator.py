"""Scripted demonstrations of NICO's tasks, in the policy's own action space.

A demonstrator moves the hand through a few noisy waypoints by inverse kinematics: above the place
from which to sweep, down to the table, sideways into the object, and for grasping closes the hand.
It follows the objects as they move.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from dm_control.rl import control
from dm_env import TimeStep

from suites.nico import kinematics
from suites.nico.base import ACTION_SCALE
from suites.nico.grasp_glass import GraspGlass
from suites.nico.physics import TABLE_HEIGHT, Physics
from suites.nico.push_green_to_glass import PushGreenToGlass
from suites.nico.push_green_to_white import PushGreenToWhite

_CLEAR_HEIGHT = TABLE_HEIGHT + 0.125  # (m) of the palm while it travels over the objects
_SWEEP_HEIGHT = TABLE_HEIGHT + 0.045  # (m) of the palm while it sweeps
_OPEN, _FIST = 0.05, 0.85  # (rad) curl of a segment

# Where a pushed box lies, as (left of the arm's plane, beyond the wrist) (m): against the fist's
# knuckles when pushed left, against the back of the hand when pushed right.
_BEFORE_KNUCKLES, _BEHIND_BACK = (0.078, 0.105), (-0.043, 0.075)
_SPEED = (0.032, 0.048)  # (rad a step) range of an episode's speed
_HAND_SPEED = 0.08  # (rad a step)
_LEAD = 0.07  # (m) by which the hand aims ahead of the box it pushes
_OUTWARD = 0.03  # (m) by which it aims beyond the arc
_NOISE = 0.006  # (m) standard deviation of the waypoints
_TREMOR = 0.06  # standard deviation of noise on the action


class _Place(Protocol):
    """Where the arm should be now: simulation -> joint angles (rad) ``[3]``."""

    def __call__(self, physics: Physics, /) -> np.ndarray: ...


@dataclass(frozen=True)
class _Phase:
    place: _Place
    curl: float
    tolerance: float = 0.035  # (rad) within which the place counts as reached


class Demonstrator:
    """Performs the task of an environment.

    Call ``reset()`` after each ``env.reset()``, then ``demonstrator(timestep)`` for each action.

    Args:
        env: A NICO environment; its task says what is demonstrated.
        seed: Seed of the noise, or its generator.

    Raises:
        ValueError: If the environment is not one of NICO's tasks.

    Example:
        >>> from suites import nico
        >>> from suites.nico.demonstrator import Demonstrator
        >>> env = nico.load("push_green_to_white", seed=1, observation="state")
        >>> demonstrator = Demonstrator(env, seed=1)
        >>> timestep = env.reset()
        >>> demonstrator.reset()
        >>> while not timestep.last():
        ...     timestep = env.step(demonstrator(timestep))
        >>> timestep.reward
        1.0
    """

    def __init__(
        self, env: control.Environment, *, seed: int | np.random.Generator | None = None
    ) -> None:
        plans: dict[type, Callable[[], Sequence[_Phase]]] = {
            GraspGlass: self._grasp_glass,
            PushGreenToGlass: lambda: self._push("green_box", "glass"),
            PushGreenToWhite: lambda: self._push("green_box", "white_box"),
        }
        plan = plans.get(type(env.task))
        if plan is None:
            raise ValueError(f"no demonstration is known for the task {type(env.task).__name__}")
        self._plan = plan
        self._physics: Physics = env.physics
        self._random = np.random.default_rng(seed)
        self._phases: list[_Phase] = []
        self._speed = 0.0

    def reset(self) -> None:
        """Plans a new demonstration for the current state of the environment."""
        self._speed = self._random.uniform(*_SPEED)
        palm = self._physics.palm_position()
        palm[2] = _CLEAR_HEIGHT
        lifted = kinematics.inverse(palm, kinematics.PALM)
        self._phases = [_Phase(lambda _: lifted, _FIST / 2), *self._plan()]

    def __call__(self, timestep: TimeStep) -> np.ndarray:
        """Returns the next action, ``[4]`` in [-1, 1].

        Raises:
            RuntimeError: If ``reset()`` was not called first.
        """
        if not self._phases:
            raise RuntimeError("call the demonstrator's reset() after the environment's reset()")
        physics = self._physics
        phase = self._phases[0]
        targets = physics.data.ctrl[:4]
        arm = phase.place(physics) - targets[:3]
        hand = phase.curl - targets[3]
        if len(self._phases) > 1 and np.abs(arm).max() < phase.tolerance:
            self._phases.pop(0)
            return self(timestep)
        arm *= min(1.0, self._speed / max(np.abs(arm).max(), 1e-6))
        hand = np.clip(hand, -_HAND_SPEED, _HAND_SPEED)
        action = np.append(arm, hand) / ACTION_SCALE
        action[:3] += _TREMOR * self._random.standard_normal(3)
        return np.clip(action, -1.0, 1.0)

    def _grasp_glass(self) -> list[_Phase]:
        """Sweep the open hand left until the glass is between thumb and fingers, then close it."""
        noise = self._random.normal(0.0, _NOISE, 3)
        right = self._random.uniform(0.065, 0.085)

        def beside(height: float) -> _Place:
            return lambda physics: self._around(
                physics, "glass", -right, height + noise[2], kinematics.GRIP, noise[:2]
            )

        def around(physics: Physics) -> np.ndarray:
            return self._around(physics, "glass", 0.004, _SWEEP_HEIGHT, kinematics.GRIP)

        def hold(physics: Physics) -> np.ndarray:
            return np.array(physics.data.ctrl[:3])

        return [
            _Phase(beside(_CLEAR_HEIGHT), _OPEN),
            _Phase(beside(_SWEEP_HEIGHT), _OPEN),
            _Phase(around, _OPEN, tolerance=0.014),
            _Phase(hold, 1.2),
        ]

    def _push(self, box: str, target: str) -> list[_Phase]:
        """Bring the fist to the box's far side from the target, then sweep the box towards it."""
        noise = self._random.normal(0.0, _NOISE, 3)
        side = np.sign(_angle(self._physics, box) - _angle(self._physics, target))
        away = side * self._random.uniform(0.025, 0.04)
        point = _BEFORE_KNUCKLES if side < 0 else _BEHIND_BACK

        def behind(height: float) -> _Place:
            return lambda physics: self._around(
                physics, box, away, height + noise[2], point, noise[:2]
            )

        def through(physics: Physics) -> np.ndarray:
            # A box pushed along the arc drifts outwards along the hand, and off it unless the hand
            # follows.
            radius, angle = kinematics.to_polar(physics.object_position(box))
            radius = (radius + kinematics.to_polar(physics.object_position(target))[0]) / 2
            place = kinematics.polar(radius + _OUTWARD, angle - side * _LEAD / radius)
            return kinematics.inverse(np.append(place, _SWEEP_HEIGHT), point)

        return [
            _Phase(behind(_CLEAR_HEIGHT), _FIST),
            _Phase(behind(_SWEEP_HEIGHT), _FIST),
            _Phase(through, _FIST),
        ]

    @staticmethod
    def _around(
        physics: Physics,
        name: str,
        left: float,
        height: float,
        point: tuple[float, float],
        noise: np.ndarray | float = 0.0,
    ) -> np.ndarray:
        """Returns the arm angles that put a point of the hand left (m, on the arc) of an object."""
        radius, angle = kinematics.to_polar(physics.object_position(name))
        place = kinematics.polar(radius, angle + left / radius) + noise
        return kinematics.inverse(np.append(place, height), point)


def _angle(physics: Physics, name: str) -> float:
    return kinematics.to_polar(physics.object_position(name))[1]
