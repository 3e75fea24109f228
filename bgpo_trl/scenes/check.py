"""Whether a scene's simulations keep what runs rely on: `check_scene`."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack

import numpy as np
from numpy.typing import NDArray

from bgpo_trl.files.checkpoint import check_state
from bgpo_trl.scenes.scene import (
    Scene,
    Simulation,
    check_executed,
    checked_frame,
    checked_numbers,
    checked_step,
)
from bgpo_trl.scenes.simulation import RobotEnv

_N_STARTS = 4
_N_STEPS = 3
# A success may have to hold for some steps.
_N_RESTING = 10
# Renderers on a GPU repeat a picture to within a few levels of 255.
_SAME = 8


def check_scene(scene: Scene, tasks: Sequence[str] | None = None) -> list[str]:
    """Play some moments of each task in two simulations; return what is doubtful, a line each.

    Doubtful is a start that is always the same, a task that is solved without movement, a frame
    that differs when it is asked for again, an action that the frame after it does not show, a
    component of actions that no frame shows, and a simulation that goes on differently after
    `Simulation.load`. A physical robot (`RobotEnv`) is not moved, an ``EnvBase`` of one's own has
    no `Simulation` to try, and nothing is said of either.

    Args:
        scene: The robot, with a simulation.
        tasks: Tasks to try, by default the scene's.

    Raises:
        ValueError: If a start does not follow from the seed, a task has always succeeded after a
            step without movement, or the simulation returns what `Simulation` does not allow.
    """
    tasks = scene.default_tasks if tasks is None else tasks
    # A physical robot has one connection, so it is closed before the next environment is made.
    with ExitStack() as opened:
        simulations = list[Simulation]()
        for _ in range(2):
            env = scene.simulate(tasks, batch_size=1)
            opened.callback(env.close)
            if isinstance(env, RobotEnv) or not hasattr(env, "simulations"):
                return []
            simulations += env.simulations
        doubts = list[str]()
        for task in tasks:
            trial, other = (_Trial(scene, task, simulation) for simulation in simulations)
            doubts += trial.doubts(other)
    return list(dict.fromkeys(doubts))


class _Trial:
    """One task, tried in a simulation."""

    def __init__(self, scene: Scene, task: str, simulation: Simulation) -> None:
        self.scene, self.task, self.simulation = scene, task, simulation

    def doubts(self, other: _Trial) -> list[str]:
        """Return what is doubtful; raise ``ValueError`` for what is wrong."""
        starts = [self.start(seed) for seed in range(_N_STARTS)]
        self.simulation.seed(0)
        other.simulation.seed(1)
        for begun, start in ((self, starts[0]), (other, starts[1])):
            if differ(begun.reset(), start):
                raise ValueError(
                    f"two episodes of {self.task!r} with one seed begin differently: "
                    f"{type(self.simulation).__name__}.seed() has to decide all that is drawn, and "
                    "in its own simulation only"
                )
        again = [self.reset() for _ in starts]
        doubts = list[str]()
        for several, what in ((starts, "with whatever seed"), (again, "reset after reset")):
            if not any(differ(frame, several[0]) for frame in several):
                doubts.append(f"episodes begin with the same frame {what}: is a start drawn?")
        rested = [self.steps_to_success(seed) for seed in range(_N_STARTS)]
        if max(rested) == 1:
            raise ValueError(
                f"{self.task!r} has succeeded after one step without movement, from each of "
                f"{_N_STARTS} starts: check reset() and success"
            )
        if max(rested) <= _N_RESTING:
            doubts.append(
                f"{self.task!r} succeeds by actions of 0 alone, from each of {_N_STARTS} starts "
                f"within {max(rested)} steps: is it solved at the start?"
            )
        return doubts + self.unseen() + self.not_loaded(other)

    def unseen(self) -> list[str]:
        """Return what actions do not change in frames."""
        size, doubts, prompt = self.scene.action_size, list[str](), False
        for component in range(size):
            push = self.scene.largest_action * np.eye(size)[component]
            pairs = list[tuple[NDArray[np.uint8], NDArray[np.uint8]]]()
            for seed in range(_N_STARTS):
                self.start(seed)
                there = self.play(push)
                self.start(seed)
                pairs += zip(there, self.play(-push), strict=True)
            if not any(differ(*pair) for pair in pairs):
                doubts.append(
                    f"component {component} (from 0) of actions changes no frame within {_N_STEPS} "
                    "steps: does it move something that the camera sees?"
                )
            prompt |= any(differ(*pair) for pair in pairs[::_N_STEPS])
            self.start(0)
            check_executed(checked_step(self.simulation, push), push)
            if differ(self.frame(), self.frame()):
                return ["frame() differs when called twice: is it that of the step before?"]
        if len(doubts) < size and not prompt:
            doubts.append(
                "the frame after the first step is the same whatever the action: is it the frame "
                "of the step before?"
            )
        return doubts

    def play(self, action: NDArray[np.float64]) -> list[NDArray[np.uint8]]:
        """Return the frames after some steps with an action; an episode's last one stays."""
        frames, over = list[NDArray[np.uint8]](), False
        for _ in range(_N_STEPS):
            over = over or any(checked_step(self.simulation, action)[:2])
            frames.append(self.frame())
        return frames

    def steps_to_success(self, seed: int) -> int:
        """Return the steps without movement to a success; if there is none, one too many."""
        self.start(seed)
        for step in range(1, _N_RESTING + 1):
            success, failure, _ = checked_step(self.simulation, np.zeros(self.scene.action_size))
            if success:
                return step
            if failure:
                break
        return _N_RESTING + 1

    def not_loaded(self, other: _Trial) -> list[str]:
        """Return whether a simulation goes on differently from what was saved."""
        self.start(0)
        try:
            saved = self.simulation.save()
        except NotImplementedError:
            return []
        try:
            check_state(saved, "save()")
        except ValueError as error:
            return [f"runs could not be saved: {error}"]
        ahead = self.ahead()
        for trial in (self, other):
            trial.simulation.load(saved)
            if any(differ(*pair) for pair in zip(trial.ahead(), ahead, strict=True)):
                return [
                    "episodes go on differently after load(), so resumed runs would too: do save() "
                    "and load() hold all that is moved and drawn, as copies?"
                ]
        return []

    def ahead(self) -> list[NDArray[np.uint8]]:
        """Return the next frames of an episode, and the first ones of the next episodes."""
        push = np.full(self.scene.action_size, self.scene.largest_action)
        return self.play(push) + [self.reset() for _ in range(_N_STEPS)]

    def start(self, seed: int) -> NDArray[np.uint8]:
        self.simulation.seed(seed)
        return self.reset()

    def reset(self) -> NDArray[np.uint8]:
        self.simulation.reset(self.task)
        if self.scene.state is not None:
            checked_numbers(self.simulation, "state", self.scene.state.size)
        if self.scene.joints is not None:
            checked_numbers(self.simulation, "joints", self.scene.joints.size)
        return self.frame()

    def frame(self) -> NDArray[np.uint8]:
        return checked_frame(self.simulation, self.scene.frame_shape)


def differ(frame: NDArray[np.uint8], other: NDArray[np.uint8]) -> bool:
    """Return whether two frames show something else, beyond what a renderer repeats."""
    return bool((np.abs(frame.astype(int) - other) > _SAME).any())
