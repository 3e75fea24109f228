"""Robots and their simulations: NICO, and whatever is added to `SCENES`."""

from bgpo_trl.scenes.scene import SCENES, Scene, StateColumns, Weights, find_scene
from bgpo_trl.scenes.simulation import Observation, Outcome, Simulation, SimulationEnv

__all__ = [
    "SCENES",
    "Observation",
    "Outcome",
    "Scene",
    "Simulation",
    "SimulationEnv",
    "StateColumns",
    "Weights",
    "find_scene",
]
