"""Meta-World (Yu et al., 2019) as a scene: fifty tasks of a Sawyer arm, seen by two cameras.

Install Meta-World as `docs/extending.md` says, and name the module and the scene on a command line:
``--import examples.meta_world --scene metaworld``. `examples/meta_world_five.py` learns five tasks.
"""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from functools import cached_property, partial
from importlib.metadata import version
from typing import Any

from examples.meta_world_frames import FRAME_SHAPE, TwoCameras, place_cameras  # isort: skip (before MuJoCo)

import mujoco
import numpy as np
from numpy.typing import NDArray

from bgpo_trl.scenes import SCENES, Outcome, Scene, Simulation, SimulationEnv, StateColumns

try:
    from metaworld.env_dict import ALL_V3_ENVIRONMENTS
    from metaworld.policies import ENV_POLICY_MAP
    from metaworld.sawyer_xyz_env import SawyerMocapBase, SawyerXYZEnv
except ModuleNotFoundError as error:
    raise ValueError(f"{error}: install Meta-World as docs/extending.md says") from None

FIVE = ("button-press-topdown", "window-open", "faucet-open", "door-close", "drawer-open")
ACTION_REPEAT = 4  # simulation steps of 12.5 ms for each action
STEADY_STEPS = 2  # actions in a row after which Meta-World has to report success
NOISE = 0.15  # standard deviation of a demonstrator's noise, in units of the action


def _reset_mocap_welds(self: SawyerMocapBase) -> None:
    """Weld the hand to its target, as Meta-World's method does for older versions of MuJoCo."""
    welds = self.model.eq_type == mujoco.mjtEq.mjEQ_WELD
    self.model.eq_data[welds, :11] = [0, 0, 0, 0, 0, 0, -1, 0, 0, 0, 5]


# The rows of eq_data were 11 long in MuJoCo 3.3, for which metaworld 3.1.1 was written.
SawyerMocapBase.reset_mocap_welds = _reset_mocap_welds


class World:
    """Meta-World's environment of a task, which all simulations of the task enter in turn.

    Most of its memory is the model. A simulation has data and attributes of its own.

    Attributes:
        samples: Points drawn of each pixel, as for `simplified`.
    """

    samples: int = 0

    def __init__(self, task: str) -> None:
        self.env: SawyerXYZEnv = ALL_V3_ENVIRONMENTS[f"{task}-v3"]()
        self.model = self.env.model
        # Goals are visible to the demonstrators, and starts drawn from the seeded generator.
        self.env._partially_observable = self.env._freeze_rand_vec = False
        del self.env.sawyer_observation_space
        self.env.seeded_rand_vec = self.env._set_task_called = True
        place_cameras(self.model)
        self._lock = threading.Lock()
        self.start = self._state()

    def _state(self) -> dict[str, Any]:
        # Meta-World moves objects by changing the model.
        places = self.model.body_pos.copy(), self.model.site_pos.copy()
        return {"attributes": dict(vars(self.env)), "places": places}

    @contextmanager
    def entered(self, state: dict[str, Any]) -> Iterator[SawyerXYZEnv]:
        """Give access to the environment in a state, which is updated at the end."""
        with self._lock:
            vars(self.env).update(state["attributes"])
            self.model.body_pos[:], self.model.site_pos[:] = state["places"]
            yield self.env
            state.update(self._state())

    @cached_property
    def camera(self) -> TwoCameras:
        """The cameras, with an OpenGL context each."""
        return TwoCameras(self.model, self.samples)


class MetaWorld(Simulation):
    """One arm and the objects of the current task.

    The start of an episode depends on the seed and the number of the episode alone.

    Args:
        worlds: Worlds by task, shared with other simulations; those missing are made when needed.
    """

    make_world: type[World] = World

    def __init__(self, worlds: dict[str, World] | None = None) -> None:
        self.worlds = {} if worlds is None else worlds
        self._data: dict[str, mujoco.MjData] = {}
        self._task, self._seed, self._episode, self._held = FIVE[0], 0, 0, 0
        self._actions: list[list[float]] = []
        self._state: dict[str, Any] = {}
        self.observation = np.zeros(39)

    @property
    def world(self) -> World:
        """World of the current task."""
        if self._task not in self.worlds:
            self.worlds[self._task] = self.make_world(self._task)
        return self.worlds[self._task]

    def seed(self, seed: int) -> None:
        """Seed the draws of all following starts."""
        self._seed, self._episode = seed, 0

    def reset(self, task: str) -> None:
        """Begin an episode of a task."""
        self._task, self._episode, self._held, self._actions = task, self._episode + 1, 0, []
        start = np.random.SeedSequence([self._seed, self._episode])
        if task not in self._data:
            self._data[task] = mujoco.MjData(self.world.model)
        self._state = copy(self.world.start)
        with self.world.entered(self._state) as env:
            env.data = self._data[task]
            env.seed(int(start.generate_state(1)[0]))
            env.reset()
            mujoco.mj_forward(env.model, env.data)  # some tasks move an object without it
            self.observation = env._get_obs()

    def step(self, action: NDArray[np.float64]) -> Outcome:
        """Perform an action: the hand's velocity along x, y and z, and closing of the gripper."""
        self._actions.append(action.tolist())
        success = False
        with self.world.entered(self._state) as env:
            for _ in range(ACTION_REPEAT):
                self.observation, _, _, _, info = env.step(action)
                success = bool(info["success"])
        self._held = self._held + 1 if success else 0
        return Outcome(success=self._held >= STEADY_STEPS)

    def frame(self) -> NDArray[np.uint8]:
        """Return both views, side by side, ``[32, 64, 3]``."""
        return self.world.camera.frame(self._data[self._task])

    def state(self) -> NDArray[Any]:
        """Return position of the hand (m), opening of the gripper, position of the object (m)."""
        return self.observation[:7]

    def joints(self) -> NDArray[Any]:
        """Return position of the hand (m) and opening of the gripper, which a real arm knows."""
        return self.observation[:4]

    def save(self) -> dict[str, Any]:
        """Return what the episode depends on, from which it can be played again."""
        actions = [list(action) for action in self._actions]
        start = {"task": self._task, "seed": self._seed, "episode": self._episode}
        return {**start, "actions": actions}

    def load(self, state: dict[str, Any]) -> None:
        """Play the saved episode again."""
        self._seed, self._episode = state["seed"], state["episode"]
        if self._episode:
            self._episode -= 1
            self.reset(state["task"])
        for action in state["actions"]:
            self.step(np.array(action))


def demonstrator(simulation: Simulation, task: str, seed: int) -> Callable[[], NDArray[np.float64]]:
    """Return Meta-World's scripted policy of a task, with noise."""
    if not isinstance(simulation, MetaWorld):
        raise TypeError(f"the policies of Meta-World act in a MetaWorld, got {simulation!r}")
    policy, noise = ENV_POLICY_MAP[f"{task}-v3"](), np.random.default_rng(seed)

    def act() -> NDArray[np.float64]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about actions beyond [-1, 1], which are clipped here
            action = policy.get_action(simulation.observation).clip(-1, 1)
        return np.clip(action + NOISE * noise.standard_normal(4), -1, 1)

    return act


def make_env(tasks: Sequence[str], **arguments: Any) -> SimulationEnv:
    """Return simulations of some tasks; arguments as for `SimulationEnv`."""
    return SimulationEnv(partial(MetaWorld, {}), tasks, **arguments)


CENTER, SCALE = (0.0, 0.65, 0.2, 0.7, 0.0, 0.8, 0.12), (0.1, 0.1, 0.1, 0.3, 0.1, 0.1, 0.08)
METAWORLD = SCENES["metaworld"] = Scene(
    name="metaworld",
    version=f"1-metaworld-{version('metaworld')}",
    tasks=[name.removesuffix("-v3") for name in ENV_POLICY_MAP],
    default_tasks=FIVE,
    make_env=make_env,
    frame_shape=FRAME_SHAPE,
    action_size=4,
    rate=20.0,
    demonstrator=demonstrator,
    state=StateColumns(center=CENTER, scale=SCALE, places={"hand": (0, 1, 2), "object": (4, 5, 6)}),
    joints=StateColumns(center=CENTER[:4], scale=SCALE[:4]),
)
