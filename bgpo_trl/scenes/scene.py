"""Scenes: what experiments need to know about a robot and its simulation."""

from __future__ import annotations

import importlib
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from reprlib import repr as short_repr
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from bgpo_trl.scenes.simulation import SimulationEnv

Observation = Literal["pixels", "state", "both"]


class Outcome(NamedTuple):
    """Outcome of a step.

    Attributes:
        success: Whether the task is solved, which ends the episode with reward 1.
        failure: Whether the episode ends without success, for example by a fall.
        executed: Action ``[A]`` in [-1, 1] that a physical robot executed, where its limits
            allowed less than was asked for; None for the action itself. See `RobotEnv`.
    """

    success: bool
    failure: bool = False
    executed: NDArray[Any] | None = None


class Simulation(ABC):
    """One simulated robot, of which `SimulationEnv` steps several side by side.

    A subclass for a robot of your own defines `seed`, `reset`, `step` and `frame`. With `state`,
    policies can learn from the ground truth; with `joints`, from the robot's joints beside frames;
    with `save` and `load`, runs can be resumed; with `view`, films show the robot.
    """

    @abstractmethod
    def seed(self, seed: int) -> None:
        """Seed the draws of all following starts, for all tasks alike; below 2**32."""

    @abstractmethod
    def reset(self, task: str) -> None:
        """Begin an episode of the task with that name, from a start drawn at random."""

    @abstractmethod
    def step(self, action: NDArray[np.float64]) -> Outcome:
        """Perform an action ``[A]`` in [-1, 1]; it may run beside the steps of others, in a thread.

        It is not called after the end of an episode.
        """

    @abstractmethod
    def frame(self) -> NDArray[np.uint8]:
        """Return the camera's frame, ``[H, W, 3]``; it is called in one thread only."""

    def state(self) -> NDArray[Any]:
        """Return the ground truth, ``[N]``."""
        raise self._lacks("state()")

    def joints(self) -> NDArray[Any]:
        """Return the readings of the robot's own joints, ``[J]``, which a real robot has too."""
        raise self._lacks("joints()")

    def view(self) -> NDArray[np.uint8]:
        """Return an onlooker's view of the robot for films, ``[H', W', 3]``."""
        raise self._lacks("view()")

    def save(self) -> dict[str, Any]:
        """Return all that the future depends on, as tensors, numbers, strings, lists and dicts."""
        raise self._lacks("save()")

    def load(self, state: dict[str, Any]) -> None:
        """Continue from what `save` returned."""
        raise self._lacks("load()")

    def close(self) -> None:  # noqa: B027 - most have nothing to free
        """Free what the simulation holds."""

    def _lacks(self, method: str) -> NotImplementedError:
        return NotImplementedError(f"{type(self).__name__} does not define {method}")


def checked_frame(simulation: Simulation, frame_shape: Sequence[int]) -> NDArray[np.uint8]:
    """Return a copy of a simulation's frame, whose array it may use again.

    NumPy would convert others, and fractions would become black.

    Raises:
        ValueError: If it is not uint8 ``[H, W, 3]`` of the height and width given.
    """
    frame, shape = np.array(simulation.frame()), (*frame_shape, 3)
    if frame.dtype != np.uint8 or frame.shape != shape:
        wanted = f"uint8 {[*shape]}, as the scene's frame_shape says"
        raise _refusal(simulation, "frame", f"{frame.dtype} {[*frame.shape]}", wanted)
    return frame


def checked_numbers(
    simulation: Simulation, method: Literal["state", "joints"], size: int
) -> NDArray[np.float32]:
    """Return a simulation's ground truth or joints, float32 ``[size]``.

    Raises:
        ValueError: If it is something else than so many finite numbers.
    """
    found = getattr(simulation, method)()
    numbers = np.asarray(found)
    kind, shape = numbers.dtype.kind, numbers.shape
    if kind in "fiu":
        with np.errstate(over="ignore"):  # what float32 does not hold is refused below
            numbers = numbers.astype(np.float32)
    if kind not in "fiu" or shape != (size,) or not np.isfinite(numbers).all():
        wanted = f"{size} finite numbers, as the scene's StateColumns say"
        raise _refusal(simulation, method, short_repr(found), wanted)
    return numbers


def checked_step(simulation: Simulation, action: NDArray[np.float64]) -> Outcome:
    """Step a simulation; return the outcome with the action that was executed.

    It is the action asked for, unless the simulation says otherwise.

    Raises:
        ValueError: If the outcome is no `Outcome` of two bools (a tuple of Gym would succeed at
            each step), or the executed action something else than finite numbers in [-1, 1], as
            many as asked for.
    """
    outcome = simulation.step(action.copy())  # which it may change in place
    flags = outcome[:2] if isinstance(outcome, Outcome) else (None,)
    if not all(type(flag) in (bool, np.bool_) for flag in flags):
        wanted = "an Outcome, whose success and failure are True or False"
        raise _refusal(simulation, "step", short_repr(outcome), wanted)
    if outcome.executed is None:
        return outcome._replace(executed=action)
    executed, shape = np.asarray(outcome.executed), action.shape
    # Comparisons with NaN are false.
    if (
        executed.dtype.kind not in "fiu"
        or executed.shape != shape
        or not (np.abs(executed) <= 1).all()
    ):
        found = f"the executed action {short_repr(executed.tolist())}"
        wanted = f"{len(action)} numbers in [-1, 1], or None"
        raise _refusal(simulation, "step", found, wanted)
    return outcome._replace(executed=executed.astype(np.float64))


def check_executed(outcome: Outcome, action: NDArray[np.float64]) -> None:
    """Raise ``ValueError`` if a simulation says that it executed another action than asked for."""
    if outcome.executed is not action:
        raise ValueError(
            "a simulation executes what it is asked: leave Outcome.executed out, or, for a real "
            "robot, make the environment a RobotEnv"
        )


def _refusal(simulation: Simulation, method: str, found: str, wanted: str) -> ValueError:
    found = " ".join(found.split())
    return ValueError(f"{type(simulation).__name__}.{method}() returned {found}: return {wanted}")


@dataclass(frozen=True, kw_only=True)
class StateColumns:
    """Meaning of the ground truth ``"state"``, float32 ``[N]``.

    It serves policies with ``state="state"`` and the probes of encoders; frames alone suffice for
    everything else.

    Attributes:
        center: Mean of each column, subtracted from what policies observe.
        scale: Spread of each column, by which it is divided.
        angles: Columns of joints (rad), by name, which probes read linearly.
        places: Columns of the coordinates of objects on the table (m), by name.
        valid: Function from states ``[..., N]`` to bool ``[...]``: frames to probe in play, such as
            those with all objects on the table; None for all.
    """

    center: Sequence[float]
    scale: Sequence[float]
    angles: Mapping[str, int] = field(default_factory=dict)
    places: Mapping[str, Sequence[int]] = field(default_factory=dict)
    valid: Callable[[Any], Any] | None = None

    def __post_init__(self) -> None:
        # Of NumPy's numbers, torch would make float64.
        for name in ("center", "scale"):
            object.__setattr__(self, name, tuple(map(float, getattr(self, name))))
        if len(self.center) != len(self.scale):
            raise ValueError(
                f"center has {len(self.center)} columns, scale has {len(self.scale)}: give as many"
            )
        for column, (center, scale) in enumerate(zip(self.center, self.scale, strict=True)):
            # Of a constant column, rounding may leave a spread that float32 does not see.
            seen = np.float32(center) + np.float32(scale) > np.float32(center)
            if not (math.isfinite(center) and 0 < scale < math.inf and seen):
                raise ValueError(
                    f"column {column} of the ground truth has the center {center} and the scale "
                    f"{scale}: give finite numbers, the scale above 0, such as 1 for a constant"
                )

        named = [*self.angles.items()]
        named += [(name, column) for name, place in self.places.items() for column in place]
        for name, column in named:
            if not 0 <= column < self.size:
                raise ValueError(
                    f"{name!r} is read from column {column} (from 0) of the ground truth, which "
                    f"has {self.size}: correct angles or places"
                )

    @property
    def size(self) -> int:
        """Number of columns."""
        return len(self.center)

    def far(self, readings: NDArray[Any]) -> bool:
        """Return whether a value of ``[..., N]`` is too far off for its unit, as degrees would be.

        That is farther than 20 scales from its center.
        """
        return bool((np.abs(readings - np.array(self.center)) > 20 * np.array(self.scale)).any())


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """A robot and its tasks: all that experiments know about a simulation.

    What is None is missing: without a ``demonstrator``, demonstrations come from elsewhere; without
    ``state``, policies learn from frames and probes leave the ground truth out; without
    ``weights``, encoders are trained or named.

    Attributes:
        name: Name in settings, files and on command lines, without spaces.
        version: Version of everything that frames and dynamics depend on. Datasets, encoders and
            banks of another version are refused.
        setup: What else they depend on, in words by name, such as the ``"camera"`` and what an
            action of 1 is in the robot's ``"units"``. If given, setup and ``rate`` are part of the
            version in all files, see `full_version`.
        tasks: Names of all tasks; may grow while the program runs.
        default_tasks: Names of the tasks of an experiment by default.
        own_tasks: Names of the tasks that come with the scene; all of them if None.
        make_env: Constructor of the environment, which gets the tasks, the `sizes` and what
            `simulate` is given; a ``spread`` only with ``has_spread``. It is `SimulationEnv` around
            a `Simulation`, or an ``EnvBase`` with the same keys, ``seed_rows`` and ``frames``.
            Without one, the scene serves demonstrations, encoders, banks and trained policies.
        frame_shape: Height and width of a frame, at least 16 each.
        action_size: Number of components of an action, each in [-1, 1].
        max_steps: Length of the longest episode.
        rate: Actions per second, the speed of films; None if it is unknown.
        largest_action: Actions with a larger component are left out of the training of the inverse
            model. Below 1 only if demonstrators never exceed it: errors of faster movements, as in
            play, would prevail in the loss.
        bank_actions: Actions of demonstrations as experience: those recorded with them, inferred
            where there are none; or always those that the inverse model infers, the only ones that
            an observer has.
        has_spread: Whether starts can be drawn from a share of their range.
        demonstrator: Function from a simulation at the start of an episode, the name of the task
            and the seed of its noise to a function that returns the next action ``[A]``.
        state: Meaning of the ground truth.
        joints: Mean and spread of each joint's reading, by which policies that read joints beside
            frames scale them (`BGPOConfig.joints`); part of what ``version`` stands for. None if
            `Simulation.joints` is not defined.
        weights: Files of encoders that come with it, each with a bank beside it (`bank_path`), and
            the tasks of each.
        modules: Modules that define tasks which are not the scene's own, by name of the task.
    """

    name: str
    version: str
    setup: Mapping[str, str] = field(default_factory=dict)
    tasks: Collection[str]
    default_tasks: tuple[str, ...]
    own_tasks: tuple[str, ...] | None = None
    make_env: Callable[..., SimulationEnv] | None = None
    frame_shape: tuple[int, int]
    action_size: int
    max_steps: int = 50
    rate: float | None = None
    largest_action: float = 1.0
    bank_actions: Literal["recorded", "inferred"] = "recorded"
    has_spread: bool = False
    demonstrator: Callable[[Simulation, str, int], Callable[[], NDArray[Any]]] | None = None
    state: StateColumns | None = None
    joints: StateColumns | None = None
    weights: Mapping[Path, Sequence[str]] = field(default_factory=dict)
    modules: Callable[[Sequence[str]], Mapping[str, str]] = lambda _: {}

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or len(self.name.split()) != 1:
            raise ValueError(f"the name of a scene is a word without spaces, got {self.name!r}")
        for what, text in (
            ("version", self.version),
            *(("setup", words) for words in (*self.setup.keys(), *self.setup.values())),
        ):
            if not isinstance(text, str) or not text.isprintable() or not text:
                raise ValueError(f"the {what} of a scene is a printable string, got {text!r}")
        if "rate" in self.setup:
            raise ValueError("the rate of a scene is no part of its setup: give it as rate")
        if min(self.frame_shape) < 16 or len(self.frame_shape) != 2:
            raise ValueError(
                f"frame_shape is {self.frame_shape}: a height and a width of at least 16 pixels"
            )
        if self.action_size < 1 or self.max_steps < 1:
            raise ValueError(
                f"action_size and max_steps must be at least 1, got {self.action_size} and "
                f"{self.max_steps}"
            )
        if isinstance(self.make_env, type) and issubclass(self.make_env, Simulation):
            name = self.make_env.__name__
            raise ValueError(
                f"make_env makes environments, but {name} is a simulation: give "
                f"partial(SimulationEnv, {name})"
            )
        if self.rate is not None and not 0 < self.rate < math.inf:
            raise ValueError(f"rate is {self.rate}: give the actions per second, or None")
        if not 0 < self.largest_action <= 1 or self.bank_actions not in ("recorded", "inferred"):
            raise ValueError(
                "largest_action lies above 0 and at most at 1, bank_actions are 'recorded' or "
                f"'inferred', got {self.largest_action} and {self.bank_actions!r}"
            )
        self.check_tasks(self.default_tasks)

    @property
    def identity(self) -> str:
        """Name and version, by which encoders and banks say whose frames they are made of."""
        return f"{self.name} {self.full_version}"

    @property
    def full_version(self) -> str:
        """The version and, if there is a setup, in brackets the setup and the rate."""
        stated = sorted({**self.setup, "rate": f"{self.rate}"}.items())
        words = "; ".join(f"{name}: {value}" for name, value in stated)
        return f"{self.version} ({words})" if self.setup else self.version

    def check_identity(self, found: str | None, what: object, remedy: str) -> None:
        """Raise ``ValueError`` if something was made for another robot, or version of this one.

        Args:
            found: Identity of the scene that it was made for, as stored with it.
            what: Its name, such as a path, which begins the message.
            remedy: What to do if it was made for another version.
        """
        if found == self.identity:
            return
        if found is None:
            raise ValueError(f"{what} names no scene, this is {self.identity}: {remedy}")
        name = found.partition(" ")[0]
        if name != self.name:
            remedy = f"name the scene {name!r} (--scene {name}), or take what is of {self.name!r}"
        raise ValueError(f"{what} is of the scene {found}, this is {self.identity}: {remedy}")

    @property
    def all_tasks(self) -> tuple[str, ...]:
        """Names of the tasks that come with the scene."""
        return tuple(self.tasks) if self.own_tasks is None else self.own_tasks

    @property
    def sizes(self) -> dict[str, Any]:
        """Sizes of frames, actions, ground truth and joints, as arguments of `SimulationEnv`."""
        columns = {"state_size": self.state, "joint_size": self.joints}
        known = {name: found.size for name, found in columns.items() if found is not None}
        return {"frame_shape": self.frame_shape, "action_size": self.action_size, **known}

    def simulate(
        self,
        tasks: Sequence[str],
        *,
        batch_size: int | Sequence[int] = (),
        seed: int | Sequence[int] | None = None,
        spread: float = 1.0,
        observation: Observation = "pixels",
    ) -> SimulationEnv:
        """Return the simulations of some tasks as an environment.

        Arguments are those of `SimulationEnv`; ``spread`` is the share of the whole range of start
        states, from 0 to 1.

        Raises:
            ValueError: If a task is unknown, or ground truth or spread are asked of a scene that
                has none.
        """
        self.check_tasks(tasks)
        self.check_spread(spread)
        if self.make_env is None:
            raise ValueError(f"the scene {self.name!r} has no simulation: give it a make_env")
        options = {**self.sizes, **({"spread": spread} if self.has_spread else {})}
        return self.make_env(
            tasks, batch_size=batch_size, seed=seed, observation=observation, **options
        )

    def check_tasks(self, tasks: Sequence[str]) -> None:
        """Raise ``ValueError`` if a task does not exist or is named twice."""
        for position, name in enumerate(tasks):
            check_name(name)
            if name not in self.tasks:
                raise ValueError(
                    f"the scene {self.name!r} has no task {name!r}: choose one of "
                    f"{', '.join(self.tasks)}, or add it first (docs/extending.md), in a module of "
                    "--import"
                )
            if name in tasks[:position]:
                raise ValueError(f"the task {name!r} is named twice: name each once")

    def check_spread(self, spread: float) -> None:
        """Raise ``ValueError`` unless starts can be drawn from that share of their range."""
        if not 0.0 <= spread <= 1.0:
            raise ValueError(f"spread is {spread}: choose a number from 0 (nominal places) to 1")
        if spread != 1.0 and not self.has_spread:
            raise ValueError(f"the starts of the scene {self.name!r} have no spread: leave it at 1")


def check_name(task: object) -> None:
    """Raise ``ValueError`` unless it can be the name of a task: printable, no space at its ends."""
    if not isinstance(task, str) or not task.isprintable() or task.strip() != task or not task:
        raise ValueError(
            f"the name of a task is a printable string that no space begins or ends, got {task!r}"
        )


SCENES: dict[str, Scene | str] = {"nico": "bgpo_trl.scenes.nico:NICO"}
"""Scenes by name, or ``"module:attribute"`` to import when they are first used. A module of
``--import`` adds its own."""


def find_scene(name: Scene | str) -> Scene:
    """Return the scene with a name; a scene is returned as it is.

    Raises:
        ValueError: If `SCENES` has none.
    """
    if isinstance(name, Scene):
        return name
    found = SCENES.get(name)
    if isinstance(found, str):
        module, _, attribute = found.partition(":")
        found = SCENES[name] = getattr(importlib.import_module(module), attribute)
    if found is None:
        raise ValueError(
            f"there is no scene {name!r}: choose one of {', '.join(SCENES)}, or name the module "
            "that adds it with --import"
        )
    return found
