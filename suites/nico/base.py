"""Base of NICO's tasks: action, start states, observations and reward."""

import hashlib
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, get_args

import numpy as np
from dm_control.rl import control
from dm_env import TimeStep, specs

from suites.nico import kinematics
from suites.nico.moves import Phase
from suites.nico.physics import OBJECT_HALF_HEIGHT, OBJECTS, TABLE_HEIGHT, Physics, scene_xml
from suites.nico.rendering import FRAME_HEIGHT, FRAME_WIDTH, FrameRenderer

Observation = Literal["pixels", "state", "both"]

CONTROL_TIMESTEP = 0.2  # (s)
TIME_LIMIT = 10.0  # (s), the paper's 50 steps
STATE_SIZE = 16

# Mean and spread, over demonstrations, of the state: joints (rad), grip, object positions (m).
STATE_CENTER = (0.3, 0.9, 0.9, 0.45, 0.36, 0, 0.68, 0.4, -0.05, 0.655, 0.43, -0.05, 0.645)
STATE_CENTER += (0.4, -0.05, 0.645)
STATE_SCALE = (0.5, 0.25, 0.35, 0.3, 0.06, 0.15, 0.05, 0.04, 0.16, 0.02, 0.03, 0.05, 0.02)
STATE_SCALE += (0.04, 0.16, 0.02)

# Change of the joint targets at |action| = 1 (rad): three arm joints, then the hand.
ACTION_SCALE = np.array([0.2, 0.2, 0.2, 0.4])

_PART = [0, 1, 2, 3, 3, 3]  # action dimension of each actuator; the last moves all three digits
_STEP = ACTION_SCALE[_PART]

# Arc about the shoulder's yaw axis along which the objects are spread; left is positive. The green
# box stands between the other two, which swap sides at random.
ARC_RADIUS = 0.40  # (m)
SIDE_ANGLE = np.radians(22.0)  # nominal angle of the glass (left) and the white box (right)
GREEN_JITTER = np.radians(9.5)
SIDE_JITTER = np.radians(8.7)
RADIUS_JITTER = 0.03  # (m)
LARGEST_STEP = 0.03  # (m) between the radii of neighbors: farther inward, a box cannot be pushed
LEAST_ANGLE = np.radians(20.0)  # between neighbors: the fist fits in
NOMINAL_ANGLES = np.array([SIDE_ANGLE, 0.0, -SIDE_ANGLE])  # of `OBJECTS`

# Range of the palm's start: in view, among or above the objects.
START_ANGLE = np.radians(30.0)  # to both sides of the middle of the arc
START_RADIUS = (0.34, 0.42)  # (m)
START_HEIGHT = (0.05, 0.12)  # (m) above the table; nominally the highest, over the green box


def scene_version() -> str:
    """Return the version of scene, starts and action, on which datasets and encoders depend."""
    layout = (ARC_RADIUS, SIDE_ANGLE, GREEN_JITTER, SIDE_JITTER, RADIUS_JITTER, LEAST_ANGLE)
    layout += (LARGEST_STEP,)
    starts = (START_ANGLE, START_RADIUS, START_HEIGHT, ACTION_SCALE.tolist())
    described = f"{scene_xml()}{layout}{starts}".encode()
    return "nico-2-" + hashlib.sha256(described).hexdigest()[:8]


def nominal_places() -> np.ndarray:
    """Return the place of the center of each of `OBJECTS` at spread 0 (m), ``[3, 3]``."""
    return np.array(
        [
            [*kinematics.polar(ARC_RADIUS, angle), TABLE_HEIGHT + OBJECT_HALF_HEIGHT[name]]
            for name, angle in zip(OBJECTS, NOMINAL_ANGLES, strict=True)
        ]
    )


class Environment(control.Environment):
    """``control.Environment`` whose last step has the discount of a termination, too."""

    def observation_spec(self) -> Mapping[str, specs.Array]:
        """Return the specs of the observation, flattened if the observation is."""
        spec = super().observation_spec()
        if not self._flat_observation:
            return spec
        values = OrderedDict((key, item.generate_value()) for key, item in spec.items())
        flat = control.flatten_observation(values)
        return {key: specs.Array(value.shape, value.dtype, key) for key, value in flat.items()}

    def step(self, action: np.ndarray) -> TimeStep:
        """Advance one control step of 0.2 s."""
        timestep = super().step(action)
        if timestep.last() and (discount := self.task.get_termination(self.physics)) is not None:
            return timestep._replace(discount=discount)
        return timestep

    def advance(self, action: np.ndarray) -> tuple[bool, bool]:
        """Advance one control step of an episode; return whether the task is solved, and ends.

        It observes nothing, for those who draw frames and read states themselves.
        """
        self.task.before_step(action, self.physics)
        self.physics.step(self._n_sub_steps)
        self.task.after_step(self.physics)
        ends = self.task.get_termination(self.physics) is not None
        return self.task.solved(self.physics), ends

    def close(self) -> None:
        """Free the renderer, unless it is shared; the next frame creates a new one."""
        self.task.close()


class NicoTask(control.Task):
    """Base class of the tasks; subclasses define success and, for recording, a demonstration.

    The action ``[4]`` in [-1, 1] moves the targets of shoulder yaw, shoulder pitch and elbow by up
    to 0.2 rad and of the hand by up to 0.4 rad per step. Before each action, a target is brought
    back to within one full step of its joint, so that the observation nearly determines the state.

    `succeeded` tests a condition at one moment, at the end of each control step. The episode
    succeeds, with reward 1, once the condition has held for `steady_steps` steps in a row. The
    count is part of the simulation's state (``physics.get_state()``), and so is where the objects
    stood at the start (``physics.start_position``), for conditions on how far something has moved.

    Start states do not depend on the task: the same seed gives all tasks the same starts.

    Args:
        random: Random state of the start states, or its seed; ``None`` for a random seed.
        spread: Share of the whole range of start states, from 0 to 1. At 0, objects are always at
            `nominal_places`, unturned, and the half-open hand is above the green box. In between,
            all deviations from that are scaled, and glass and white box swap sides with probability
            ``spread / 2``.
        observation: ``"pixels"`` (uint8 ``[32, 64, 3]``), ``"state"`` (``privileged_state``, the
            ground truth, float64 ``[16]``: joints (rad), grip and object positions (m)) or
            ``"both"``.
        frame_size: Height and width of ``pixels``.
        renderer: Renderer shared with other environments; created on demand if ``None``.

    Attributes:
        steady_steps: Number of control steps in a row for which `succeeded` has to hold.

    Raises:
        ValueError: If there is no such observation, ``spread`` is not in [0, 1], or the renderer
            has another frame size.
    """

    steady_steps: ClassVar[int] = 1

    def __init__(
        self,
        *,
        random: int | np.random.RandomState | None = None,
        spread: float = 1.0,
        observation: Observation = "pixels",
        frame_size: Sequence[int] = (FRAME_HEIGHT, FRAME_WIDTH),
        renderer: FrameRenderer | None = None,
    ) -> None:
        if observation not in get_args(Observation):
            choices = ", ".join(map(repr, get_args(Observation)))
            raise ValueError(f"observation is {observation!r}; choose one of {choices}")
        if not 0.0 <= spread <= 1.0:
            raise ValueError(f"spread is {spread}: choose a number from 0 (nominal places) to 1")
        if renderer is not None and renderer.frame_size != tuple(frame_size):
            raise ValueError(
                f"frame_size is {tuple(frame_size)}, but the renderer's frames are "
                f"{renderer.frame_size}: give both the same"
            )
        # dm_control's wrappers replace this attribute by name: TorchRL's `set_seed`, shimmy's
        # `reset(seed=...)`.
        self._random = (
            random if isinstance(random, np.random.RandomState) else np.random.RandomState(random)
        )
        self.spread = float(spread)
        self._observation = observation
        self._frame_size = tuple(frame_size)
        self._renderer = renderer
        self._shares_renderer = renderer is not None

    @property
    def random(self) -> np.random.RandomState:
        """Random state of the start states."""
        return self._random

    def succeeded(self, physics: Physics) -> bool:
        """Return whether the condition of success holds at this moment.

        The episode succeeds once this has held for `steady_steps` control steps in a row.
        """
        raise NotImplementedError

    def demonstration(self, physics: Physics, random: np.random.Generator) -> Sequence[Phase]:
        """Return the movement that solves the task, planned at the start of an episode.

        The demonstrator lifts the hand above the objects before the first phase.

        Args:
            physics: The simulation at the start of the episode.
            random: Source of all variation between demonstrations.
        """
        raise NotImplementedError

    def initialize_episode(self, physics: Physics) -> None:
        """Place the objects and the hand at random, within the spread."""
        for name, place, turn in zip(OBJECTS, *self._object_places(), strict=True):
            height = TABLE_HEIGHT + OBJECT_HALF_HEIGHT[name]
            half = turn / 2
            physics.named.data.qpos[name] = [*place, height, np.cos(half), 0, 0, np.sin(half)]
        # Resamples until the hand touches nothing.
        touching = True
        while touching:
            self._place_arm(physics)
            physics.forward()
            touching = physics.robot_touches()
        physics.begin_episode()

    def _object_places(self) -> tuple[list[np.ndarray], np.ndarray]:
        """Draw the places ``[x, y]`` (m) and turns (rad) of the objects, in the order `OBJECTS`.

        The whole range is drawn from, whatever the spread, and scaled afterwards: what neighbors
        have to keep between them holds for what is drawn and for the nominal places, hence for all
        that lies in between.
        """
        swapped = self.random.uniform() < self.spread / 2
        nominal = NOMINAL_ANGLES[::-1] if swapped else NOMINAL_ANGLES
        green = self.random.uniform(-GREEN_JITTER, GREEN_JITTER)
        left, right = (
            self.random.uniform(
                max(SIDE_ANGLE - SIDE_JITTER, LEAST_ANGLE + inward), SIDE_ANGLE + SIDE_JITTER
            )
            for inward in (green, -green)
        )
        drawn = np.array([-right, green, left] if swapped else [left, green, -right])
        angles = nominal + self.spread * (drawn - nominal)
        jitter = self.random.uniform(-RADIUS_JITTER, RADIUS_JITTER, 3)
        while np.abs(np.diff(jitter)).max() > LARGEST_STEP:
            jitter = self.random.uniform(-RADIUS_JITTER, RADIUS_JITTER, 3)
        radii: np.ndarray = ARC_RADIUS + self.spread * jitter
        turns = self.spread * self.random.uniform(-np.pi, np.pi, 3)
        return [kinematics.polar(r, a) for r, a in zip(radii, angles, strict=True)], turns

    def _place_arm(self, physics: Physics) -> None:
        lowest, highest = np.transpose(
            [
                (-START_ANGLE, START_ANGLE),
                START_RADIUS,
                START_HEIGHT,
                physics.named.model.jnt_range["thumb_1"],
            ]
        )
        middle = (lowest + highest) / 2
        drawn = middle + (highest - lowest) / 2 * self.random.uniform(-1.0, 1.0, 4)
        # Of the middle of the range, the hand would touch the green box at its nominal place.
        nominal = np.array([middle[0], middle[1], highest[2], middle[3]])
        angle, radius, height, curl = (1.0 - self.spread) * nominal + self.spread * drawn
        palm = np.append(kinematics.polar(radius, angle), TABLE_HEIGHT + height)
        arm = kinematics.inverse(palm, kinematics.PALM)
        physics.data.qpos[:12] = [*arm, *[curl] * 9]
        physics.data.ctrl[:] = [*arm, curl, curl, curl]

    def before_step(self, action: np.ndarray, physics: Physics) -> None:
        """Move the joint targets by the action.

        Raises:
            ValueError: If the action is not 4 finite numbers.
        """
        action = np.asarray(action, dtype=float)
        if action.shape != (4,) or not np.isfinite(action).all():
            raise ValueError(f"an action is 4 finite numbers in [-1, 1], not {action.tolist()}")
        joints, (lowest, highest) = physics.actuated_angles(), physics.actuated_limits
        target = np.minimum(np.maximum(physics.data.ctrl, joints - _STEP), joints + _STEP)
        target += _STEP * np.minimum(np.maximum(action, -1.0), 1.0)[_PART]
        physics.set_control(np.minimum(np.maximum(target, lowest), highest))

    def after_step(self, physics: Physics) -> None:
        """Count the steps in a row for which `succeeded` has held."""
        physics.count_steady(self.succeeded(physics))

    def action_spec(self, physics: Physics) -> specs.BoundedArray:
        """Return the spec of the action: float64 ``[4]`` in [-1, 1]."""
        del physics
        return specs.BoundedArray((4,), float, [-1.0] * 4, [1.0] * 4, name="action")

    def observation_spec(self, physics: Physics) -> OrderedDict[str, specs.Array]:
        """Return the specs of the observation, without rendering."""
        del physics
        observation: OrderedDict[str, specs.Array] = OrderedDict()
        if self._observation != "state":
            shape = (*self._frame_size, 3)
            observation["pixels"] = specs.BoundedArray(shape, np.uint8, 0, 255, name="pixels")
        if self._observation != "pixels":
            name = "privileged_state"  # TorchRL's wrapper renames a `state`, but not its spec.
            observation[name] = specs.Array((STATE_SIZE,), float, name=name)
        return observation

    def get_observation(self, physics: Physics) -> OrderedDict[str, np.ndarray]:
        """Return new arrays: ``pixels`` uint8 ``[H, W, 3]``, ``privileged_state`` ``[16]``."""
        observation: OrderedDict[str, np.ndarray] = OrderedDict()
        if self._observation != "state":
            model, own = physics.model.ptr, not self._shares_renderer
            if self._renderer is None or (own and self._renderer.model is not model):
                self.close()
                height, width = self._frame_size
                self._renderer = FrameRenderer(model, height=height, width=width)
            observation["pixels"] = self._renderer.render(physics.data.ptr)
        if self._observation != "pixels":
            observation["privileged_state"] = physics.privileged_state()
        return observation

    def solved(self, physics: Physics) -> bool:
        """Return whether `succeeded` has held for `steady_steps` steps."""
        return physics.steady_steps >= self.steady_steps

    def get_reward(self, physics: Physics) -> float:
        """Return 1 if the task is `solved`, else 0."""
        return float(self.solved(physics))

    def get_termination(self, physics: Physics) -> float | None:
        """Return discount 0 if the task is `solved`, else ``None``.

        A subclass may end episodes otherwise, too, which counts as a failure.
        """
        return 0.0 if self.solved(physics) else None

    def close(self) -> None:
        """Free the renderer if it was created on demand."""
        if self._renderer is not None and not self._shares_renderer:
            self._renderer.close()
            self._renderer = None
