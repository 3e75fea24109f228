"""Press on the white box with the fist."""

from collections.abc import Sequence

import numpy as np

from suites.nico import moves
from suites.nico.base import NicoTask
from suites.nico.physics import Physics

CLOSED = 0.6  # (rad) mean curl beyond which the hand is a fist


class PressWhite(NicoTask):
    """Success: the fist touches the white box from above."""

    def succeeded(self, physics: Physics) -> bool:
        """Return whether the fist touches the top of the white box."""
        return bool(physics.joint_angles()[3] > CLOSED) and physics.pressed("white_box")

    def demonstration(self, physics: Physics, random: np.random.Generator) -> Sequence[moves.Phase]:
        """Return a press on the white box."""
        return moves.press(physics, random, "white_box")
