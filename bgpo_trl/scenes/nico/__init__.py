"""NICO at the table, the scene of the paper."""

from bgpo_trl.scenes.nico.env import NicoEnv, NicoSimulation
from bgpo_trl.scenes.nico.scene import NICO

__all__ = ["NICO", "NicoEnv", "NicoSimulation"]
