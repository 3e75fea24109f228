"""Push the green box towards the red glass (Task 2 of the paper)."""

from collections.abc import Sequence

import numpy as np

from suites.nico import moves
from suites.nico.base import NicoTask
from suites.nico.physics import Physics


class PushGreenToGlass(NicoTask):
    """Success: the green box touches the glass, standing or knocked over."""

    def succeeded(self, physics: Physics) -> bool:
        """Return whether the green box touches the glass."""
        return physics.touching("green_box", "glass")

    def demonstration(self, physics: Physics, random: np.random.Generator) -> Sequence[moves.Phase]:
        """Return a push of the green box to the glass."""
        return moves.push(physics, random, "green_box", "glass")
