"""Push the white box to the left, towards the green box."""

import math
from collections.abc import Sequence

import numpy as np

from suites.nico import kinematics, moves
from suites.nico.base import NicoTask
from suites.nico.physics import Physics

MOVED = math.radians(-14.0)  # angle on the arc; the starts are around -22 degrees


class PushWhiteLeft(NicoTask):
    """Success: the white box is 8 degrees to the left of its usual place, or farther."""

    def succeeded(self, physics: Physics) -> bool:
        """Return whether the white box is nearer to the green box."""
        return kinematics.to_polar(physics.object_position("white_box"))[1] > MOVED

    def demonstration(self, physics: Physics, random: np.random.Generator) -> Sequence[moves.Phase]:
        """Return a push of the white box to the left."""
        return moves.push_aside(physics, random, "white_box", -1)
