"""NICO as a scene: its tasks, demonstrator, ground truth and encoders."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import torch
from numpy.typing import NDArray

from bgpo_trl.scenes.nico.env import FRAME_SHAPE, NicoEnv, NicoSimulation
from bgpo_trl.scenes.scene import Scene, StateColumns, Weights
from bgpo_trl.scenes.simulation import Simulation
from suites import nico
from suites.nico.base import STATE_CENTER, STATE_SCALE
from suites.nico.demonstrator import Demonstrator

__all__ = ["NICO"]

_FIRST_OBJECT = 7  # column of the state, after four joints (rad) and the grip point (m)


def _demonstrator(simulation: Simulation, task: int, seed: int) -> Callable[[], NDArray[Any]]:
    """Return NICO's demonstrator at the start of an episode."""
    if not isinstance(simulation, NicoSimulation):
        raise TypeError(f"NICO's demonstrator acts in a NicoSimulation, got {simulation!r}")
    demonstrator = Demonstrator(simulation.environments[task], seed=seed)
    demonstrator.reset()
    return lambda: demonstrator(simulation.timestep)


def _objects_on_table(state: torch.Tensor) -> torch.Tensor:
    """Return whether all objects are above 0.6 m, bool, for states ``[..., 16]``."""
    return (state[..., _FIRST_OBJECT + 2 :: 3] > 0.6).all(-1)


_PAPER, _EIGHT = (
    Path(str(resources.files("bgpo_trl") / "weights" / name))
    for name in ("nico.safetensors", "nico_eight.safetensors")
)


def _weights_for(tasks: Sequence[str]) -> Path:
    """Return the encoders of eight tasks if one of the suite's further five is among them.

    Otherwise, also for custom tasks, return those of the paper's three.
    """
    further = set(nico.ALL_TASKS) - set(nico.PAPER_TASKS)
    return _PAPER if further.isdisjoint(tasks) else _EIGHT


def _modules(tasks: Sequence[str]) -> Mapping[str, str]:
    return {name: nico.TASKS[name].__module__ for name in tasks if name not in nico.ALL_TASKS}


NICO = Scene(
    name="nico",
    version=nico.scene_version(),
    tasks=nico.TASKS,
    default_tasks=nico.PAPER_TASKS,
    own_tasks=nico.ALL_TASKS,
    make_env=NicoEnv,
    frame_shape=FRAME_SHAPE,
    action_size=4,
    max_steps=50,
    has_spread=True,
    demonstrator=_demonstrator,
    state=StateColumns(
        center=STATE_CENTER,
        scale=STATE_SCALE,
        angles={name: column for column, name in enumerate(("yaw", "pitch", "elbow", "hand"))},
        places={
            name: (_FIRST_OBJECT + 3 * number, _FIRST_OBJECT + 3 * number + 1)
            for number, name in enumerate(("glass", "green", "white"))
        },
        valid=_objects_on_table,
    ),
    weights=Weights(files=(_PAPER, _EIGHT), choose=_weights_for),
    modules=_modules,
)
"""NICO at the table, the scene of the paper."""
