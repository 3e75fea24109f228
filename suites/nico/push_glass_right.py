"""Push the red glass to the right, towards the boxes."""

import math
from collections.abc import Sequence

import numpy as np

from suites.nico import kinematics, moves
from suites.nico.base import NicoTask
from suites.nico.physics import Physics

MOVED = math.radians(14.0)  # angle on the arc; the starts are around 22 degrees


class PushGlassRight(NicoTask):
    """Success: the glass is 8 degrees to the right of its usual place, or farther."""

    def succeeded(self, physics: Physics) -> bool:
        """Return whether the glass is nearer to the boxes."""
        return kinematics.to_polar(physics.object_position("glass"))[1] < MOVED

    def demonstration(self, physics: Physics, random: np.random.Generator) -> Sequence[moves.Phase]:
        """Return a push of the glass to the right."""
        return moves.push_aside(physics, random, "glass", 1)
