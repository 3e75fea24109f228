"""Push the white box to the right, away from the other objects."""

import math
from collections.abc import Sequence

import numpy as np

from suites.nico import kinematics, moves
from suites.nico.base import NicoTask
from suites.nico.physics import Physics

MOVED = math.radians(-34.0)  # angle on the arc; the starts are around -22 degrees


class PushWhiteRight(NicoTask):
    """Success: the white box is 12 degrees to the right of its usual place, or farther."""

    def succeeded(self, physics: Physics) -> bool:
        """Return whether the white box is at the right."""
        return kinematics.to_polar(physics.object_position("white_box"))[1] < MOVED

    def demonstration(self, physics: Physics, random: np.random.Generator) -> Sequence[moves.Phase]:
        """Return a push of the white box to the right."""
        return moves.push_aside(physics, random, "white_box", 1)
