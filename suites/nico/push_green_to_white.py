"""Push the green box towards the white box (Task 3 of the paper)."""

from collections.abc import Sequence

import numpy as np

from suites.nico import moves
from suites.nico.base import NicoTask
from suites.nico.physics import Physics


class PushGreenToWhite(NicoTask):
    """Success: the green box touches the white box."""

    def succeeded(self, physics: Physics) -> bool:
        """Return whether the green box touches the white box."""
        return physics.touching("green_box", "white_box")

    def demonstration(self, physics: Physics, random: np.random.Generator) -> Sequence[moves.Phase]:
        """Return a push of the green box to the white box."""
        return moves.push(physics, random, "green_box", "white_box")
