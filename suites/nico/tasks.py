"""The eight tasks: what counts as success, and the movement that demonstrates it.

A success is what a person would call so: its condition (`succeeded`) has to hold for some control
steps in a row (`steady_steps`), so that a touch in passing, a thrown object or a glass that slips
out of the hand earns nothing. Conditions hold wherever the objects are, and none holds at a start.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Final, Literal

import numpy as np

from suites.nico import kinematics, moves
from suites.nico.base import NicoTask
from suites.nico.physics import OBJECT_HALF_HEIGHT, OBJECTS, TABLE_HEIGHT, Physics

LIFTED: Final = 0.015  # (m) above the table
DISPLACED: Final = 0.05  # (m)
FIST: Final = 0.6  # (rad) mean curl beyond which the hand is a fist


class Grasp(NicoTask):
    """Success: the closing hand holds an object for three steps."""

    thing: ClassVar[str]
    steady_steps = 3

    def succeeded(self, physics: Physics) -> bool:
        """Return whether the object is between thumb and fingers of the closing hand now."""
        return physics.held(self.thing)

    def demonstration(self, physics: Physics, random: np.random.Generator) -> Sequence[moves.Phase]:
        """Return a grasp of the object."""
        return moves.grasp(physics, random, self.thing)


class Lift(NicoTask):
    """Success: the closing hand holds an object over 1.5 cm above the table for three steps."""

    thing: ClassVar[str]
    steady_steps = 3

    def succeeded(self, physics: Physics) -> bool:
        """Return whether the object is held above the table now."""
        height = physics.object_position(self.thing)[2] - OBJECT_HALF_HEIGHT[self.thing]
        return bool(height > TABLE_HEIGHT + LIFTED) and physics.held(self.thing)

    def demonstration(self, physics: Physics, random: np.random.Generator) -> Sequence[moves.Phase]:
        """Return a lift of the object."""
        return moves.lift(physics, random, self.thing)


class Press(NicoTask):
    """Success: the fist rests on an object for two steps."""

    thing: ClassVar[str]
    steady_steps = 2

    def succeeded(self, physics: Physics) -> bool:
        """Return whether the fist touches the object from above now."""
        return bool(physics.joint_angles()[3] > FIST) and physics.pressed(self.thing)

    def demonstration(self, physics: Physics, random: np.random.Generator) -> Sequence[moves.Phase]:
        """Return a press on the object."""
        return moves.press(physics, random, self.thing)


class PushTogether(NicoTask):
    """Success: a box touches its target, wherever that is, for two steps."""

    thing: ClassVar[str]
    target: ClassVar[str]
    steady_steps = 2

    def succeeded(self, physics: Physics) -> bool:
        """Return whether the box touches its target now."""
        return physics.touching(self.thing, self.target)

    def demonstration(self, physics: Physics, random: np.random.Generator) -> Sequence[moves.Phase]:
        """Return a push of the box to its target."""
        return moves.push(physics, random, self.thing, self.target)


class PushAside(NicoTask):
    """Success: an object stands more than 5 cm to one side of where it started, for two steps.

    The displacement is measured along the arc about the shoulder's yaw axis. The other objects are
    within 5 cm of where they started: an arm that sweeps the table clear has not pushed one aside.
    """

    thing: ClassVar[str]
    side: ClassVar[Literal["left", "right"]]
    steady_steps = 2

    def succeeded(self, physics: Physics) -> bool:
        """Return whether the object, and no other, has moved far, to the side, and stands now."""
        radius, angle = kinematics.to_polar(physics.object_position(self.thing))
        before = kinematics.to_polar(physics.start_position(self.thing))[1]
        left = radius * (angle - before)
        moved = left if self.side == "left" else -left
        if moved <= DISPLACED or not physics.stands(self.thing):
            return False
        others = (name for name in OBJECTS if name != self.thing)
        return all(_displacement(physics, name) <= DISPLACED for name in others)

    def demonstration(self, physics: Physics, random: np.random.Generator) -> Sequence[moves.Phase]:
        """Return a push of the object to the side."""
        return moves.push_aside(physics, random, self.thing, -1 if self.side == "left" else 1)


def _displacement(physics: Physics, name: str) -> float:
    """Return how far an object is from where it started (m), also if that is off the table."""
    moved = physics.object_position(name) - physics.start_position(name)
    return float(np.linalg.norm(moved))


class GraspGlass(Grasp):
    """Grasp the red glass (Task 1 of the paper)."""

    thing = "glass"


class PushGreenToGlass(PushTogether):
    """Push the green box to the red glass (Task 2 of the paper)."""

    thing, target = "green_box", "glass"


class PushGreenToWhite(PushTogether):
    """Push the green box to the white box (Task 3 of the paper)."""

    thing, target = "green_box", "white_box"


class PushGlassRight(PushAside):
    """Push the red glass to the right."""

    thing, side = "glass", "right"


class LiftGreen(Lift):
    """Lift the green box off the table."""

    thing = "green_box"


class PressWhite(Press):
    """Press on the white box with the fist."""

    thing = "white_box"


class PushWhiteLeft(PushAside):
    """Push the white box to the left."""

    thing, side = "white_box", "left"


class PushWhiteRight(PushAside):
    """Push the white box to the right."""

    thing, side = "white_box", "right"
