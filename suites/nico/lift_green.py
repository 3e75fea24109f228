"""Lift the green box off the table."""

from collections.abc import Sequence

import numpy as np

from suites.nico import moves
from suites.nico.base import NicoTask
from suites.nico.physics import OBJECT_HALF_HEIGHT, TABLE_HEIGHT, Physics

LIFTED = TABLE_HEIGHT + OBJECT_HALF_HEIGHT["green_box"] + 0.015  # (m) height of the center


class LiftGreen(NicoTask):
    """Success: the hand holds the green box at least 1.5 cm above the table."""

    def succeeded(self, physics: Physics) -> bool:
        """Return whether the box is held above the table."""
        height = physics.object_position("green_box")[2]
        return bool(height > LIFTED) and physics.held("green_box")

    def demonstration(self, physics: Physics, random: np.random.Generator) -> Sequence[moves.Phase]:
        """Return a lift of the green box."""
        return moves.lift(physics, random, "green_box")
