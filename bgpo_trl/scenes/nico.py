"""NICO at the table, the scene of the paper: the suite `suites.nico` as simulations."""

# MuJoCo's bindings come without stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from bgpo_trl.scenes.scene import Outcome, Scene, Simulation, StateColumns
from bgpo_trl.scenes.simulation import SimulationEnv
from bgpo_trl.seeding import random_state, set_random_state
from suites import nico
from suites.nico.base import STATE_CENTER, STATE_SCALE, Environment
from suites.nico.demonstrator import Demonstrator
from suites.nico.rendering import FRAME_HEIGHT, FRAME_WIDTH, FrameRenderer

_ROOM = (180, 70, 600, 350)  # (pixels) crop of the 640x480 room view to NICO and the table


class NicoSimulation(Simulation):
    """NICO at the table, with one physics for all tasks.

    Args:
        tasks: Names of the tasks.
        spread: Share of the whole range of start states.

    Attributes:
        environments: Environment of each task, by name.
        task: Name of the current task.
        renderer: Renderer of the frames, which other simulations may share.
    """

    renderer: FrameRenderer | None = None

    def __init__(self, tasks: Sequence[str], *, spread: float = 1.0) -> None:
        physics = nico.Physics.from_xml_string(nico.scene_xml())
        random = np.random.RandomState(0)  # All tasks draw from one source.
        self.environments = {
            task: nico.load(
                task,
                seed=random,
                spread=spread,
                observation="state",  # Frames are drawn in one thread, by `frame`.
                time_limit=float("inf"),
                physics=physics,
            )
            for task in tasks
        }
        self.task = tasks[0]
        self._room: FrameRenderer | None = None

    @property
    def environment(self) -> Environment:
        """Environment of the current task."""
        return self.environments[self.task]

    def seed(self, seed: int) -> None:
        """Seed the draws of all following starts."""
        self.environment.task.random.seed(seed)

    def reset(self, task: str) -> None:
        """Begin an episode of a task."""
        self.task = task
        self.environment.reset()

    def step(self, action: NDArray[np.float64]) -> Outcome:
        """Perform an action ``[4]``; without success, an episode ends only if its task says so."""
        solved, ends = self.environment.advance(action)
        return Outcome(solved, failure=ends and not solved)

    def frame(self) -> NDArray[np.uint8]:
        """Return NICO's view, ``[32, 64, 3]``."""
        return self.draw(self.environment.physics)

    def draw(self, physics: nico.Physics) -> NDArray[np.uint8]:
        """Return NICO's view of any physics of the scene, ``[32, 64, 3]``."""
        if self.renderer is None:
            self.renderer = FrameRenderer(physics.model.ptr)
        return self.renderer.render(physics.data.ptr)

    def state(self) -> NDArray[Any]:
        """Return joints (rad), grip and object positions (m), ``[16]``."""
        return self.environment.physics.privileged_state()

    def joints(self) -> NDArray[Any]:
        """Return the arm's three angles and the hand's mean curl (rad), ``[4]``."""
        return self.environment.physics.joint_angles()

    def view(self) -> NDArray[np.uint8]:
        """Return NICO at the table, seen from the room, ``[280, 420, 3]``."""
        physics = self.environment.physics
        if self._room is None:
            self._room = FrameRenderer(physics.model.ptr, "room", height=480, width=640)
        left, top, right, bottom = _ROOM
        return self._room.render(physics.data.ptr)[top:bottom, left:right]

    def close(self) -> None:
        """Free the renderer of the room."""
        if self._room is not None:
            self._room.close()
            self._room = None

    def save(self) -> dict[str, Any]:
        """Return the state of physics and random numbers."""
        return {
            "task": self.task,
            "physics": torch.from_numpy(self.environment.physics.get_state()),
            "random": random_state(self.environment.task.random),
        }

    def load(self, state: dict[str, Any]) -> None:
        """Continue from what `save` returned."""
        self.task = state["task"]
        self.environment.physics.set_state(state["physics"].numpy())
        set_random_state(self.environment.task.random, state["random"])
        for environment in self.environments.values():
            environment._reset_next_step = False


class NicoEnv(SimulationEnv):
    """NICO at the table as a TorchRL environment; keys and behavior as of `SimulationEnv`.

    ``"pixels"`` are ``[*B, 32, 64, 3]``, ``"joints"`` ``[*B, 4]`` (rad), ``"state"`` ``[*B, 16]``:
    joints, grip and object positions (m). Actions are ``[*B, 4]``. All simulations share one
    renderer, which draws the looks of the first one's model. Episodes end on success only: append
    ``StepCounter(50)`` for the paper's time limit.

    Args:
        tasks: Names of the tasks, in the order of their presentation.
        spread: Share of the whole range of start states, from 0 (nominal places) to 1.
        **options: ``batch_size``, ``seed``, ``observation`` and ``threads`` of `SimulationEnv`.

    Raises:
        ValueError: If a task is unknown or named twice, the spread is out of range, or as for
            `SimulationEnv`.

    Examples:
        >>> env = NicoEnv(batch_size=[2], seed=0)
        >>> env.rollout(3)["pixels"].shape
        torch.Size([2, 3, 32, 64, 3])
    """

    def __init__(
        self,
        tasks: Sequence[str] = nico.PAPER_TASKS,
        *,
        spread: float = 1.0,
        **options: Any,
    ) -> None:
        self._spread = spread
        self._renderer: FrameRenderer | None = None
        super().__init__(self._make, tasks, **{**NICO.sizes, **options})

    def _make(self) -> NicoSimulation:
        simulation = self._simulation()
        if self._renderer is None and self.observation != "state":
            self._renderer = FrameRenderer(simulation.environment.physics.model.ptr)
        simulation.renderer = self._renderer
        return simulation

    def _simulation(self) -> NicoSimulation:
        return NicoSimulation(self.tasks, spread=self._spread)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """End the threads and free the renderer."""
        super().close(raise_if_closed=raise_if_closed)
        if self._renderer is not None:
            self._renderer.close()


_N_JOINTS = 4  # first columns of the state (rad)
_FIRST_OBJECT = 7  # column of the state, after joints and the grip point (m)


def _demonstrator(simulation: Simulation, task: str, seed: int) -> Callable[[], NDArray[Any]]:
    """Return NICO's demonstrator at the start of an episode."""
    if not isinstance(simulation, NicoSimulation):
        raise TypeError(f"NICO's demonstrator acts in a NicoSimulation, got {simulation!r}")
    demonstrator = Demonstrator(simulation.environments[task], seed=seed)
    demonstrator.reset()
    return demonstrator


def _objects_on_table(state: torch.Tensor) -> torch.Tensor:
    """Return whether all objects are above 0.6 m, bool, for states ``[..., 16]``."""
    return (state[..., _FIRST_OBJECT + 2 :: 3] > 0.6).all(-1)


_PAPER, _EIGHT = (
    Path(str(resources.files("bgpo_trl") / "weights" / name))
    for name in ("nico.safetensors", "nico_eight.safetensors")
)


def _modules(tasks: Sequence[str]) -> Mapping[str, str]:
    return {name: nico.TASKS[name].__module__ for name in tasks if name not in nico.ALL_TASKS}


NICO = Scene(
    name="nico",
    version=nico.scene_version(),
    tasks=nico.TASKS,
    default_tasks=nico.PAPER_TASKS,
    own_tasks=nico.ALL_TASKS,
    make_env=NicoEnv,
    frame_shape=(FRAME_HEIGHT, FRAME_WIDTH),
    action_size=4,
    max_steps=50,
    rate=5.0,
    largest_action=0.6,
    bank_actions="inferred",
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
    joints=StateColumns(center=STATE_CENTER[:_N_JOINTS], scale=STATE_SCALE[:_N_JOINTS]),
    weights={_PAPER: nico.PAPER_TASKS, _EIGHT: nico.ALL_TASKS},
    modules=_modules,
)
"""NICO at the table, the scene of the paper."""
