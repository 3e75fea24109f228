"""Building blocks of demonstrations: phases of a movement, and the movements of NICO's tasks.

A movement leads the hand by inverse kinematics through a few noisy waypoints: above the start
of the sweep, down to the table and sideways into the object, where it may close, or from above
onto the object. The waypoints follow the objects as they move. Phases that may get stuck, against
the table or a neighbor, end after some steps; a movement that has failed is planned anew.

Movements take the simulation at the start of the episode, the source of their noise, and the names
of objects.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from suites.nico import kinematics
from suites.nico.physics import OBJECT_HALF_HEIGHT, OBJECTS, TABLE_HEIGHT, Physics

# Height of the palm (m) while it travels: the lowest digit passes over the glass, 7 cm high.
CLEAR_HEIGHT: Final = TABLE_HEIGHT + 0.125
# Height of the palm (m) while it sweeps: the digits clear the table and meet the boxes, 5 cm high.
SWEEP_HEIGHT: Final = TABLE_HEIGHT + 0.045
OPEN: Final = 0.05  # (rad) curl of a segment, just off the joint's stop
FIST: Final = 0.85  # (rad) curl of a segment, just short of the joint's other stop
GRIP: Final = 1.2  # (rad) curl of a segment, beyond what the joints reach, for a firm grip

# Contact point of a pushed box, as (left of the arm's plane, beyond the wrist) (m): the fist's
# knuckles when pushed left, the back of the hand when pushed right. Both lie outside of the hand by
# about half a box, so that the point is where the box's center should be.
_BEFORE_KNUCKLES, _BEHIND_BACK = (0.078, 0.09), (-0.043, 0.045)
_FRONT = (0.02, 0.12)  # front of the fist, between palm and fingers
# Lead of the hand's target over the box it pushes (m), more than the arm moves in a step: the speed
# is then the demonstrator's, and the direction that of the goal.
_LEAD = 0.14
# Radius (m) beyond which the fingers, not the middle of the hand, push a box to the right: with the
# middle, the arm would have to be nearly straight.
_MIDDLE_REACH = 0.415
# Goal of a push aside, from the object: ahead on the arc (rad), and beyond the radius at which the
# object started (m). It is the direction that counts: along the arc, and back to the radius.
_AHEAD, _OUT = 0.08, 0.02
# Distance from the grip at which the descending palm just misses the center of a box (m).
_PALM = 0.094
_LIFT_HEIGHT = TABLE_HEIGHT + 0.039  # (m) of the grip around a box to lift; higher, it slips
# Mean lead of the targets over the curls (rad) from which on the hand is closed firmly enough to
# lift: the object holds the digits back, whose targets go on.
_FIRM = 0.25
# From the grip to the place at which a lift aims (m): always ahead, so that the arm rises on.
_RISE = np.array([0.0, 0.0, 0.04])
_NOISE = 0.006  # (m) standard deviation of the waypoints, so that no two demonstrations are alike


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
    until: Callable[[Physics], bool] | None = None
    """Further condition for the end of the phase."""
    pace: float = 1.0
    """Factor of the demonstrator's speed."""
    limit: int = 50
    """Steps after which the phase ends in any case, as long as an episode by default. After the
    last phase, the movement is planned anew."""


def grasp(physics: Physics, random: np.random.Generator, name: str) -> Sequence[Phase]:
    """Sweep the open hand left until an object is between thumb and fingers, then close it."""
    return [*_reach(physics, random, name), Phase(_stay, GRIP, limit=14)]


def lift(physics: Physics, random: np.random.Generator, name: str) -> Sequence[Phase]:
    """Grasp a box as in `grasp`, then raise it."""

    def is_firm(physics: Physics) -> bool:
        return (physics.data.ctrl[3:] - physics.digit_curls()).mean() > _FIRM

    def up(physics: Physics) -> np.ndarray:
        return kinematics.inverse(physics.grip_position() + _RISE, kinematics.GRIP)

    reach = _reach(physics, random, name, _LIFT_HEIGHT)
    return [
        *reach,
        Phase(_stay, GRIP, until=is_firm, limit=14),
        Phase(up, GRIP, limit=12),
    ]


def _reach(
    physics: Physics, random: np.random.Generator, name: str, sweep_height: float = SWEEP_HEIGHT
) -> Sequence[Phase]:
    """Return a sweep of the open hand to the left that ends with an object in it."""
    noise = random.normal(0.0, _NOISE, 3)
    # The palm would otherwise come down on a near neighbor; but 3 cm to the object have to remain.
    right = min(random.uniform(0.065, 0.085), max(_room_on_the_right(physics, name) - _PALM, 0.03))

    def beside(height: float) -> Place:
        return lambda physics: beside_object(
            physics, name, -right, height + noise[2], kinematics.GRIP, noise[:2]
        )

    def around(physics: Physics) -> np.ndarray:
        return beside_object(physics, name, 0.004, sweep_height, kinematics.GRIP)

    return [
        Phase(beside(CLEAR_HEIGHT), OPEN),
        Phase(beside(sweep_height), OPEN, limit=8),
        Phase(around, OPEN, tolerance=0.014, limit=9),
    ]


def push(physics: Physics, random: np.random.Generator, box: str, target: str) -> Sequence[Phase]:
    """Move the fist to a box's far side from its target, then sweep the box towards the target."""
    side = np.sign(_angle(physics, box) - _angle(physics, target))
    return _sweep(physics, random, box, side, lambda physics: physics.object_position(target)[:2])


def push_aside(
    physics: Physics, random: np.random.Generator, name: str, side: Literal[-1, 1]
) -> Sequence[Phase]:
    """Move the fist beside an object, then sweep the object along the arc to the other side.

    ``side`` is 1 to push from the left to the right, -1 to push from the right to the left.
    """
    start = _radius(physics, name)

    def ahead(physics: Physics) -> np.ndarray:
        return kinematics.polar(start + _OUT, _angle(physics, name) - side * _AHEAD)

    return _sweep(physics, random, name, side, ahead)


def _sweep(
    physics: Physics,
    random: np.random.Generator,
    name: str,
    side: float,
    goal: Callable[[Physics], np.ndarray],
) -> Sequence[Phase]:
    """Return a sweep of the fist along the arc that takes an object with it.

    ``side`` is 1 to start on the object's left, -1 on its right; ``goal`` returns the place
    ``[x, y]`` (m) to which the sweep leads, evaluated at each step.
    """
    noise = random.normal(0.0, _NOISE, 3)
    away = side * random.uniform(0.012, 0.025)
    left, beyond = _BEFORE_KNUCKLES if side < 0 else _BEHIND_BACK
    if side > 0:  # A far box would be out of reach of the middle of the hand.
        beyond += max(0.0, _radius(physics, name) - _MIDDLE_REACH)
    point = left, beyond

    def behind(height: float) -> Place:
        return lambda physics: beside_object(
            physics, name, away, height + noise[2], point, noise[:2]
        )

    def through(physics: Physics) -> np.ndarray:
        # The hand's rough skin takes the object along in the direction in which the hand moves.
        box = physics.object_position(name)[:2]
        way = goal(physics) - box
        place = box + _LEAD * way / max(np.linalg.norm(way), 1e-6)
        return kinematics.inverse(np.append(place, SWEEP_HEIGHT), point)

    return [
        Phase(behind(CLEAR_HEIGHT), FIST),
        Phase(behind(SWEEP_HEIGHT), FIST, limit=8),
        Phase(through, FIST, limit=20),
    ]


def press(physics: Physics, random: np.random.Generator, name: str) -> Sequence[Phase]:
    """Move the fist high above an object, then down onto it."""
    del physics
    noise = random.normal(0.0, _NOISE, 3)
    top = TABLE_HEIGHT + 2 * OBJECT_HALF_HEIGHT[name]

    def over(height: float) -> Place:
        return lambda physics: beside_object(
            physics, name, 0.0, top + height + noise[2], _FRONT, noise[:2]
        )

    return [
        Phase(over(0.15), FIST, tolerance=0.014, limit=24, pace=0.85),
        Phase(over(-0.03), FIST, limit=16, pace=0.85),
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


def _stay(physics: Physics) -> np.ndarray:
    return np.array(physics.data.ctrl[:3])


def _room_on_the_right(physics: Physics, name: str) -> float:
    """Return the distance along the arc (m) to the next object on the right, if any."""
    radius, angle = kinematics.to_polar(physics.object_position(name))
    others = [angle - _angle(physics, other) for other in OBJECTS if other != name]
    return radius * min((turn for turn in others if turn > 0), default=np.inf)


def _radius(physics: Physics, name: str) -> float:
    return kinematics.to_polar(physics.object_position(name))[0]


def _angle(physics: Physics, name: str) -> float:
    return kinematics.to_polar(physics.object_position(name))[1]
