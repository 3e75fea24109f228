"""Building blocks of demonstrations: phases of a movement, and the movements of NICO's tasks.

A movement leads the hand by inverse kinematics through a few noisy waypoints: above the start
of the sweep, down to the table, sideways into the object, and for grasping closes the hand. The
waypoints follow the objects as they move.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from suites.nico import kinematics
from suites.nico.physics import TABLE_HEIGHT, Physics

CLEAR_HEIGHT: Final = TABLE_HEIGHT + 0.125  # (m) of the palm while it travels over the objects
SWEEP_HEIGHT: Final = TABLE_HEIGHT + 0.045  # (m) of the palm while it sweeps
OPEN: Final = 0.05  # (rad) curl of a segment
FIST: Final = 0.85  # (rad) curl of a segment

# Contact point of a pushed box, as (left of the arm's plane, beyond the wrist) (m): the fist's
# knuckles when pushed left, the back of the hand when pushed right.
_BEFORE_KNUCKLES, _BEHIND_BACK = (0.078, 0.105), (-0.043, 0.075)
_LEAD = 0.07  # (m) by which the hand aims ahead of the box it pushes
_OUTWARD = 0.03  # (m) by which it aims beyond the arc
_NOISE = 0.006  # (m) standard deviation of the waypoints


Place = Callable[[Physics], np.ndarray]
"""Target of the arm: maps the simulation to joint angles (rad) ``[3]``."""


@dataclass(frozen=True)
class Phase:
    """Part of a movement, which ends when its place is reached; the last phase goes on."""

    place: Place
    """Target of the arm, evaluated at each step."""
    curl: float
    """Angle of each of the hand's segments (rad); `OPEN` and `FIST` are usual."""
    tolerance: float = 0.035
    """Largest distance of a joint from the target at which the phase ends (rad)."""


def grasp(physics: Physics, random: np.random.Generator, name: str) -> Sequence[Phase]:
    """Sweep the open hand left until an object is between thumb and fingers, then close it.

    Args:
        physics: The simulation at the start of the episode.
        random: Source of the noise.
        name: The object.
    """
    del physics
    noise = random.normal(0.0, _NOISE, 3)
    right = random.uniform(0.065, 0.085)

    def beside(height: float) -> Place:
        return lambda physics: beside_object(
            physics, name, -right, height + noise[2], kinematics.GRIP, noise[:2]
        )

    def around(physics: Physics) -> np.ndarray:
        return beside_object(physics, name, 0.004, SWEEP_HEIGHT, kinematics.GRIP)

    def hold(physics: Physics) -> np.ndarray:
        return np.array(physics.data.ctrl[:3])

    return [
        Phase(beside(CLEAR_HEIGHT), OPEN),
        Phase(beside(SWEEP_HEIGHT), OPEN),
        Phase(around, OPEN, tolerance=0.014),
        Phase(hold, 1.2),
    ]


def push(physics: Physics, random: np.random.Generator, box: str, target: str) -> Sequence[Phase]:
    """Move the fist to a box's far side from its target, then sweep the box towards the target.

    Args:
        physics: The simulation at the start of the episode.
        random: Source of the noise.
        box: The object to push.
        target: The object to push it to.
    """
    noise = random.normal(0.0, _NOISE, 3)
    side = np.sign(_angle(physics, box) - _angle(physics, target))
    away = side * random.uniform(0.025, 0.04)
    point = _BEFORE_KNUCKLES if side < 0 else _BEHIND_BACK

    def behind(height: float) -> Place:
        return lambda physics: beside_object(
            physics, box, away, height + noise[2], point, noise[:2]
        )

    def through(physics: Physics) -> np.ndarray:
        # A box pushed along the arc drifts outwards along the hand, so the hand follows outwards.
        radius, angle = kinematics.to_polar(physics.object_position(box))
        radius = (radius + kinematics.to_polar(physics.object_position(target))[0]) / 2
        place = kinematics.polar(radius + _OUTWARD, angle - side * _LEAD / radius)
        return kinematics.inverse(np.append(place, SWEEP_HEIGHT), point)

    return [
        Phase(behind(CLEAR_HEIGHT), FIST),
        Phase(behind(SWEEP_HEIGHT), FIST),
        Phase(through, FIST),
    ]


def beside_object(
    physics: Physics,
    name: str,
    left: float,
    height: float,
    point: tuple[float, float],
    noise: np.ndarray | float = 0.0,
) -> np.ndarray:
    """Return the arm angles (rad) ``[3]`` that put a point of the hand to the left of an object.

    Args:
        physics: The simulation now.
        name: The object.
        left: Distance to the object's left along the arc (m); negative is right.
        height: Height of the hand's point (m).
        point: The hand's point, as in `kinematics.inverse`.
        noise: Added to ``[x, y]`` of the place (m).
    """
    radius, angle = kinematics.to_polar(physics.object_position(name))
    place = kinematics.polar(radius, angle + left / radius) + noise
    return kinematics.inverse(np.append(place, height), point)


def _angle(physics: Physics, name: str) -> float:
    return kinematics.to_polar(physics.object_position(name))[1]
