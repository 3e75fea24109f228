"""Grasp the red glass (Task 1 of the paper)."""

from collections.abc import Sequence

import numpy as np

from suites.nico import moves
from suites.nico.base import NicoTask
from suites.nico.physics import Physics


class GraspGlass(NicoTask):
    """Success: the closing hand holds the glass between thumb and fingers."""

    def succeeded(self, physics: Physics) -> bool:
        """Return whether the glass is held."""
        return physics.held("glass")

    def demonstration(self, physics: Physics, random: np.random.Generator) -> Sequence[moves.Phase]:
        """Return a grasp of the glass."""
        return moves.grasp(physics, random, "glass")
