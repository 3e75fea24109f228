"""NICO's table with frames that hide where the objects are: the policy's picture, not the world."""

# MuJoCo's bindings come without stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from bgpo_trl.scenes.nico.env import NicoEnv, NicoSimulation
from suites import nico
from suites.nico.physics import OBJECTS

Hidden = Literal["places", "objects"]


class HidingSimulation(NicoSimulation):
    """NICO at the table, whose observations hide where the objects are.

    Frames and ground truth show each object at its nominal place and turn; if only places are
    hidden, moved and turned from there as it was since the start of the episode. The arm is shown
    as it is.

    Args:
        tasks: As for `NicoSimulation`, as is ``spread``.
        shown: Physics to show; the true one is only read. Others may share it.
        hidden: ``"places"`` hides where objects started, ``"objects"`` also how they move.
    """

    def __init__(
        self, tasks: Sequence[str], *, shown: nico.Physics, hidden: Hidden, spread: float = 1.0
    ) -> None:
        super().__init__(tasks, spread=spread)
        self._hides_movement = hidden == "objects"
        self._shown = shown
        joints = [shown.model.joint(name).qposadr[0] for name in OBJECTS]
        self._poses = np.add.outer(joints, np.arange(7))
        self._nominal = np.hstack([nico.nominal_places(), [[1.0, 0.0, 0.0, 0.0]] * len(OBJECTS)])
        self._start = self._nominal

    def reset(self, task: int) -> None:
        """Begin an episode of a task."""
        super().reset(task)
        self._start = self.environment.physics.data.qpos[self._poses].copy()

    def _show(self) -> nico.Physics:
        """Return the physics to show, in its state of this moment."""
        true, shown = self.environment.physics.data.qpos, self._shown
        poses = self._nominal
        if not self._hides_movement:
            poses = _moved(self._nominal, self._start, true[self._poses])
        shown.data.qpos[:] = true
        shown.data.qpos[self._poses] = poses
        # All that is drawn follows from positions, hence without contacts and forces.
        mujoco.mj_kinematics(shown.model.ptr, shown.data.ptr)
        mujoco.mj_camlight(shown.model.ptr, shown.data.ptr)
        return shown

    def frame(self) -> NDArray[np.uint8]:
        """Return NICO's view of the shown scene, ``[32, 64, 3]``."""
        return self.draw(self._show())

    def state(self) -> NDArray[Any]:
        """Return the ground truth of the shown scene, ``[16]``."""
        return self.environment.task.get_observation(self._show())["privileged_state"]


class HidingEnv(NicoEnv):
    """`NicoEnv` of `HidingSimulation`.

    Args:
        tasks: As for `NicoEnv`, as are all other arguments.
        hidden: As for `HidingSimulation`.
    """

    def __init__(
        self, tasks: Sequence[str] = nico.PAPER_TASKS, *, hidden: Hidden, **arguments: Any
    ) -> None:
        self._hidden: Hidden = hidden
        self._shown = nico.Physics.from_xml_string(nico.scene_xml())
        super().__init__(tasks, **arguments)

    def _simulation(self) -> HidingSimulation:
        return HidingSimulation(
            self.tasks, shown=self._shown, hidden=self._hidden, spread=self._spread
        )


def _moved(poses: NDArray, start: NDArray, now: NDArray) -> NDArray:
    """Move and turn poses ``[N, 7]``, position and quaternion, as others from ``start`` to now."""
    out = poses.copy()
    out[:, :3] += now[:, :3] - start[:, :3]
    back, turn = np.empty((2, 4))
    for i in range(len(poses)):
        mujoco.mju_negQuat(back, start[i, 3:])
        mujoco.mju_mulQuat(turn, now[i, 3:], back)
        mujoco.mju_mulQuat(out[i, 3:], turn, poses[i, 3:])
    return out
