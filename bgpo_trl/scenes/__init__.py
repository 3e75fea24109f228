"""Robots and their simulations: NICO, and whatever is added to `SCENES`."""

from typing import TYPE_CHECKING

from bgpo_trl.scenes.scene import (
    SCENES,
    Observation,
    Outcome,
    Scene,
    Simulation,
    StateColumns,
    find_scene,
)

if TYPE_CHECKING:
    from bgpo_trl.scenes.simulation import RobotEnv, SimulationEnv
else:

    def __getattr__(name):
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        # TorchRL takes seconds to import: commands that only name a scene do not wait for it.
        from bgpo_trl.scenes import simulation

        return getattr(simulation, name)


__all__ = [
    "SCENES",
    "Observation",
    "Outcome",
    "RobotEnv",
    "Scene",
    "Simulation",
    "SimulationEnv",
    "StateColumns",
    "find_scene",
]
