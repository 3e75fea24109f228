"""Scripted demonstrations of NICO's tasks, in the policy's action space.

Each task defines the movement (`NicoTask.demonstration`, `suites.nico.moves`); the demonstrator
performs it with a random speed per episode and noise on the actions.
"""

import numpy as np
from dm_control.rl import control
from dm_env import TimeStep

from suites.nico import kinematics
from suites.nico.base import ACTION_SCALE, NicoTask
from suites.nico.moves import CLEAR_HEIGHT, FIST, Phase
from suites.nico.physics import Physics

_SPEED = (0.045, 0.065)  # (rad a step) range of an episode's speed
_HAND_SPEED = 0.1  # (rad a step)
_TREMOR = 0.06  # standard deviation of noise on the action


class Demonstrator:
    """Scripted policy for the task of an environment.

    Call ``reset()`` after each ``env.reset()``, then ``demonstrator(timestep)`` for each action. It
    reads the simulation; the time step may be left out.

    Args:
        env: A NICO environment, whose task defines the demonstration.
        seed: Seed of the noise, or its generator.

    Raises:
        ValueError: If the environment's task defines no demonstration.

    Examples:
        >>> from suites import nico
        >>> from suites.nico.demonstrator import Demonstrator
        >>> env = nico.load("push_green_to_white", seed=1, observation="state")
        >>> demonstrator = Demonstrator(env, seed=1)
        >>> timestep = env.reset()
        >>> demonstrator.reset()
        >>> while not timestep.last():
        ...     timestep = env.step(demonstrator(timestep))
        >>> timestep.reward
        1.0
    """

    def __init__(
        self, env: control.Environment, *, seed: int | np.random.Generator | None = None
    ) -> None:
        task = env.task
        if not isinstance(task, NicoTask) or type(task).demonstration is NicoTask.demonstration:
            raise ValueError(
                f"no demonstration is known for the task {type(task).__name__}: give it a method "
                "demonstration()"
            )
        self._task = task
        self._physics: Physics = env.physics
        self._random = np.random.default_rng(seed)
        self._phases: list[Phase] = []
        self._speed = 0.0
        self._steps = 0  # of the current phase
        self._time = 0.0  # (s) of the latest action

    def reset(self) -> None:
        """Plan a new demonstration from the current state of the environment."""
        self._speed, self._time = self._random.uniform(*_SPEED), self._physics.time()
        self._plan()

    def _plan(self) -> None:
        palm = self._physics.palm_position()
        palm[2] = CLEAR_HEIGHT
        lifted = kinematics.inverse(palm, kinematics.PALM)
        plan = self._task.demonstration(self._physics, self._random)
        self._phases = [Phase(lambda _: lifted, FIST / 2), *plan]
        self._steps = 0

    def __call__(self, timestep: TimeStep | None = None) -> np.ndarray:
        """Return the next action, ``[4]`` in [-1, 1].

        Raises:
            RuntimeError: If ``reset()`` was not called first, or not in this episode.
        """
        physics, targets = self._physics, self._physics.data.ctrl[:4]
        if not self._phases or physics.time() < self._time:
            raise RuntimeError("call the demonstrator's reset() after the environment's reset()")
        self._time = physics.time()
        arm = self._phases[0].place(physics) - targets[:3]
        while self._ends(arm):
            self._phases.pop(0)
            self._steps = 0
            if not self._phases:
                self._plan()
            arm = self._phases[0].place(physics) - targets[:3]
        self._steps += 1
        hand = self._phases[0].curl - targets[3]
        speed = self._speed * self._phases[0].pace
        arm *= min(1.0, speed / max(np.abs(arm).max(), 1e-6))
        hand = np.clip(hand, -_HAND_SPEED, _HAND_SPEED)
        action = np.append(arm, hand) / ACTION_SCALE
        action[:3] += _TREMOR * self._random.standard_normal(3)
        return np.clip(action, -1.0, 1.0)

    def _ends(self, arm: np.ndarray) -> bool:
        """Return whether the current phase ends, given the way of the joints to its place (rad)."""
        phase, is_last = self._phases[0], len(self._phases) == 1
        if self._steps >= phase.limit:
            return True
        near = bool(np.abs(arm).max() < phase.tolerance)
        return near and not is_last and (phase.until is None or phase.until(self._physics))
