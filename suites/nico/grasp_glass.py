"""Grasp the red glass (Task 1 of the paper)."""

from collections.abc import Sequence

import numpy as np

from suites.nico import moves
from suites.nico.base import NicoTask
from suites.nico.physics import Physics


class GraspGlass(NicoTask):
    """Done when the glass is held between thumb and fingers with the hand closing on it."""

    def succeeded(self, physics: Physics) -> bool:
        """Returns whether the task is done."""
        return physics.held("glass")

    def demonstration(self, physics: Physics, random: np.random.Generator) -> Sequence[moves.Phase]:
        """Returns the movement that does the task."""
        return moves.grasp(physics, random, "glass")
