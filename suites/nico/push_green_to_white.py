"""Push the green box towards the white box (Task 3 of the paper)."""

from suites.nico.base import NicoTask
from suites.nico.physics import Physics


class PushGreenToWhite(NicoTask):
    """Done when the green box touches the white box."""

    def succeeded(self, physics: Physics) -> bool:
        """Returns whether the task is done."""
        return physics.touching("green_box", "white_box")
