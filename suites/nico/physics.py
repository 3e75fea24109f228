"""Simulation of NICO at the table, with named geometric queries."""

# MuJoCo's bindings come without stubs.
# pyright: reportAttributeAccessIssue=false

import itertools
from functools import cached_property
from importlib import resources
from typing import Any, Final

import mujoco
import numpy as np
from dm_control import mujoco as dm_mujoco

OBJECTS: Final = ("glass", "green_box", "white_box")
ARM_JOINTS: Final = ("shoulder_yaw", "shoulder_pitch", "elbow")
HAND: Final = "hand"
DIGITS: Final = ("thumb", "upper_finger", "lower_finger")
TABLE_HEIGHT: Final = 0.62  # (m)
OBJECT_HALF_HEIGHT: Final = {"glass": 0.035, "green_box": 0.025, "white_box": 0.025}  # (m)

_FULL_STATE = mujoco.mjtState.mjSTATE_INTEGRATION.value
_TOUCH_GAP = 0.002  # (m) distance below which two objects touch
_VERTICAL = 0.9  # least vertical component of the normal of a contact from above
_PRESSING = 0.02  # (rad) lead of the target over the curl above which a hand is closing


def scene_xml() -> str:
    """Return the MJCF of the scene."""
    return resources.files("suites.nico").joinpath("nico.xml").read_text()


class Physics(dm_mujoco.Physics):
    """MuJoCo simulation with the queries of NICO's tasks, demonstrator and probes.

    Those that take the ``name`` of an object raise ``ValueError`` if it is not one of `OBJECTS`.
    """

    # Indices are cached, since a lookup by `named` takes much longer than the read itself.

    def _reload_from_data(self, data: Any) -> None:
        for name, member in vars(Physics).items():
            if isinstance(member, cached_property):
                vars(self).pop(name, None)
        super()._reload_from_data(data)

    @cached_property
    def _arm(self) -> list[int]:
        return [self.model.joint(name).qposadr[0] for name in ARM_JOINTS]

    @cached_property
    def _curls(self) -> list[int]:
        return [self.model.joint(f"{digit}_1").qposadr[0] for digit in DIGITS]

    @cached_property
    def _ids(self) -> dict[str, dict[str, int]]:
        counts = {"body": self.model.nbody, "geom": self.model.ngeom, "site": self.model.nsite}
        return {
            kind: {self.model.id2name(i, kind): i for i in range(count)}
            for kind, count in counts.items()
        }

    def _object_id(self, kind: str, name: str) -> int:
        if name not in OBJECTS:
            raise ValueError(f"no object {name!r} in the scene; choose one of {', '.join(OBJECTS)}")
        return self._ids[kind][name]

    @cached_property
    def _hand(self) -> list[int]:
        # One pass suffices, since each body comes after its parent.
        bodies = {self._ids["body"][HAND]}
        for body, parent in enumerate(self.model.body_parentid):
            if parent in bodies:
                bodies.add(body)
        return [geom for geom, body in enumerate(self.model.geom_bodyid) if body in bodies]

    def _geoms(self, name: str) -> list[int]:
        if name == HAND:
            return self._hand
        if name not in self._ids["geom"]:
            names = ", ".join([HAND, *self._ids["geom"]])
            raise ValueError(f"no {name!r} in the scene; choose one of {names}")
        return [self._ids["geom"][name]]

    @cached_property
    def actuated_limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest angle (rad) of the joint of each actuator, ``[6]`` each."""
        lowest, highest = self.model.jnt_range[self.model.actuator_trnid[:, 0]].T
        return lowest, highest

    def actuated_angles(self) -> np.ndarray:
        """Return the angle (rad) of the joint of each actuator, ``[6]``."""
        return self.data.qpos[self._arm + self._curls]

    def arm_angles(self) -> np.ndarray:
        """Return shoulder yaw, shoulder pitch and elbow (rad), ``[3]``."""
        return self.data.qpos[self._arm]

    def digit_curls(self) -> np.ndarray:
        """Return the angle (rad) of each segment of thumb, upper and lower finger, ``[3]``."""
        return self.data.qpos[self._curls]

    def joint_angles(self) -> np.ndarray:
        """Return the arm's three angles and the hand's mean curl (rad), ``[4]``."""
        return np.append(self.arm_angles(), self.digit_curls().mean())

    def grip_position(self) -> np.ndarray:
        """Return the center of the grip, where a held glass would be (m), ``[3]``."""
        return self.data.site_xpos[self._ids["site"]["grip"]].copy()

    def palm_position(self) -> np.ndarray:
        """Return the centre of the palm (m), ``[3]``."""
        return self.data.site_xpos[self._ids["site"]["palm"]].copy()

    def object_position(self, name: str) -> np.ndarray:
        """Return the center of an object (m), ``[3]``."""
        return self.data.xpos[self._object_id("body", name)].copy()

    def start_position(self, name: str) -> np.ndarray:
        """Return where an object's center was at the start of the episode (m), ``[3]``."""
        self._object_id("body", name)
        return self.data.userdata[1:].reshape(-1, 3)[OBJECTS.index(name)].copy()

    # Kept in MuJoCo's user data, so that `get_state` has all that an episode remembers.

    def begin_episode(self) -> None:
        """Store where the objects are, for `start_position`, and set `steady_steps` to 0."""
        self.data.userdata[0] = 0.0
        self.data.userdata[1:] = np.concatenate([self.object_position(name) for name in OBJECTS])

    @property
    def steady_steps(self) -> int:
        """Number of latest control steps in a row for which the condition of success has held."""
        return int(self.data.userdata[0])

    def count_steady(self, holds: bool) -> None:
        """Add a control step to `steady_steps`, or set it to 0 if the condition does not hold."""
        self.data.userdata[0] = self.data.userdata[0] + 1.0 if holds else 0.0

    def privileged_state(self) -> np.ndarray:
        """Return joint angles (rad) ``[4]``, grip (m) ``[3]`` and object positions (m) ``[9]``."""
        objects = [self.object_position(name) for name in OBJECTS]
        return np.concatenate([self.joint_angles(), self.grip_position(), *objects])

    def get_state(self, sig: int | None = None) -> np.ndarray:
        """Return the full state of the simulation as one vector.

        Unlike dm_control's, it includes the joint targets, which actions move: positions and
        velocities alone do not determine the future.

        Args:
            sig: Parts to return instead, bits of ``mujoco.mjtState``.
        """
        return super().get_state(_FULL_STATE if sig is None else sig)

    def set_state(self, physics_state: np.ndarray, sig: int | None = None) -> None:
        """Restore a result of `get_state` exactly, without a need for ``forward()``.

        Args:
            physics_state: State vector of this simulation or of another one of the same scene.
            sig: Parts that it holds, as in `get_state`.

        Raises:
            ValueError: If it has another length.
        """
        sig = _FULL_STATE if sig is None else sig
        size = mujoco.mj_stateSize(self.model.ptr, sig)
        if np.shape(physics_state) != (size,):
            raise ValueError(
                f"the state is a vector of {size} numbers, got {list(np.shape(physics_state))}: "
                "take one from get_state()"
            )
        super().set_state(physics_state, sig)
        mujoco.mj_forward(self.model.ptr, self.data.ptr)

    def gap(self, first: str, second: str) -> float:
        """Return the smallest distance between two things (m), at most 1; negative if they overlap.

        Args:
            first: An object, ``"table"``, ``"hand"`` (palm, wrist and digits) or any other geom.
            second: The other, named in the same way.

        Raises:
            ValueError: If the scene has no such thing.
        """
        pairs = itertools.product(self._geoms(first), self._geoms(second))
        model, data = self.model.ptr, self.data.ptr
        return min(mujoco.mj_geomDistance(model, data, *pair, 1.0, None) for pair in pairs)

    def touching(self, first: str, second: str) -> bool:
        """Return whether two things, named as in `gap`, touch."""
        return self.gap(first, second) < _TOUCH_GAP

    def robot_touches(self) -> bool:
        """Return whether any part of the robot touches the table or an object."""
        bodies = self.model.body_rootid[self.model.geom_bodyid]
        robot = self._ids["body"]["torso"]
        geoms = self.data.contact.geom
        return bool((bodies[geoms] == robot).any())

    def pressed(self, name: str) -> bool:
        """Return whether the hand touches an object's top or another part of it from above."""
        geom = self._object_id("geom", name)
        for contact in self.data.contact:
            # The normal points from the first geom to the second.
            up = contact.frame[2] if contact.geom1 == geom else -contact.frame[2]
            pair = {contact.geom1, contact.geom2}
            if geom in pair and pair & set(self._hand) and up > _VERTICAL:
                return True
        return False

    def stands(self, name: str) -> bool:
        """Return whether an object stands upright on the table, not on another of its sides.

        It may be moving.
        """
        body = self._object_id("body", name)
        low = self.data.xpos[body, 2] - TABLE_HEIGHT < OBJECT_HALF_HEIGHT[name] + _TOUCH_GAP
        return bool(self.data.xmat[body, 8] > _VERTICAL and low)

    def held(self, name: str) -> bool:
        """Return whether an object is between thumb and finger side of a closing hand.

        A finger and the thumb or palm must touch it. It may stand or have been knocked over. A hand
        is closing if its target lies beyond its mean curl.
        """
        held = self._object_id("geom", name)
        lead = self.data.ctrl[len(ARM_JOINTS) :] - self.digit_curls()
        if not lead.mean() > _PRESSING:
            return False
        touched = set()
        for contact in self.data.contact:
            pair = (contact.geom1, contact.geom2)
            if held in pair:
                touched.add(self.model.id2name(pair[0] if pair[1] == held else pair[1], "geom"))
        finger_side = any("finger" in name for name in touched)
        thumb_side = any(name == "palm" or name.startswith("thumb") for name in touched)
        return finger_side and thumb_side
