"""Simulations of a robot as one TorchRL environment, batched and switching task at each reset."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from bgpo_trl.errors import as_shape, missing_key
from bgpo_trl.machine import RowPool, usable_cores
from bgpo_trl.scenes.scene import (
    Observation,
    Outcome,
    Simulation,
    check_executed,
    checked_frame,
    checked_numbers,
    checked_step,
)
from bgpo_trl.seeding import Seeding, row_seeds


class SimulationEnv(EnvBase):
    """Simulations of several tasks, one for each element of the batch.

    All run in this process. Threads step them, and the caller's thread draws each frame as soon as
    its simulation has finished; results do not depend on the number of threads. The task of an
    episode is chosen at reset, by the entry ``"task"`` of the reset's tensordict. Episodes end as
    the simulation says: append ``StepCounter(max_steps)`` for a time limit.

    Writes at reset and step: ``"pixels"`` uint8 ``[*B, H, W, 3]`` and/or ``"state"`` float32
    ``[*B, N]``; with ``joint_size``, ``"joints"`` float32 ``[*B, J]``; ``"task"`` int64 ``[*B]``,
    an index into ``tasks``; ``"success"`` bool ``[*B, 1]``. Reads ``"action"`` float32 ``[*B, A]``
    in [-1, 1]; numbers beyond count as its ends. ``"reward"`` is 1 on success, else 0;
    ``"terminated"`` and ``"done"`` are success or failure, ``"truncated"`` is never set here.

    An optional boolean entry ``"_step"`` ``[*B]`` selects the simulations that advance; the others
    repeat their last observation.

    ``set_seed`` also reaches the transforms of this package, at the next reset (see
    `EpisodeTransform`). A copy, by ``copy.deepcopy`` or ``pickle``, continues as the original
    would, if the simulation's copy does, with threads of its own. Workers of a ``ParallelEnv``
    therefore draw alike until the ``ParallelEnv``'s ``set_seed``, which seeds each differently.

    Args:
        make: Constructor of a simulation, called once for each element of the batch.
        tasks: Names of the tasks, in the order of their numbers.
        frame_shape: Height and width of a frame.
        action_size: Number of components of an action.
        state_size: Length of the ground truth; None if there is none.
        joint_size: Number of joints to observe, see `Simulation.joints`; None for none.
        batch_size: Shape of the batch; an int is the length of a batch of one dimension.
        seed: Seed of the first simulation's starts, from which the others count up; or one for
            each; or None for seeds from the operating system.
        observation: ``"pixels"``, ``"state"`` or ``"both"``.
        threads: Threads that step, the caller's among them; None takes one for each core.

    Raises:
        ValueError: If there are not as many seeds as simulations, a seed is out of range, or there
            is to be no task, one task twice, no simulation or thread, or ground truth that the
            simulation lacks.
    """

    def __init__(
        self,
        make: Callable[[], Simulation],
        tasks: Sequence[str],
        *,
        frame_shape: Sequence[int],
        action_size: int,
        state_size: int | None = None,
        joint_size: int | None = None,
        batch_size: int | Sequence[int] = (),
        seed: int | Sequence[int] | None = None,
        observation: Observation = "pixels",
        threads: int | None = None,
    ) -> None:
        super().__init__(batch_size=as_shape(batch_size, "batch_size"), device="cpu")
        if observation not in get_args(Observation):
            choices = ", ".join(map(repr, get_args(Observation)))
            raise ValueError(f"observation is {observation!r}; choose one of {choices}")
        if threads is not None and threads < 1:
            raise ValueError(f"threads must be at least 1, or None for all cores, got {threads}")
        if not tasks or isinstance(tasks, str) or len({*tasks}) < len(tasks):
            raise ValueError(f"tasks must be a sequence of names, all different, got {tasks!r}")
        if observation != "pixels" and state_size is None:
            raise ValueError("the simulation has no ground truth: observe pixels")
        self.tasks = tuple(tasks)
        self.observation: Observation = observation
        count = self.batch_size.numel()
        seeds = row_seeds(seed, count)
        self.seeding: Seeding | None = None  # read by the transforms
        self.simulations = [make() for _ in seeds]
        self.seed_rows(seeds)
        self._threads = RowPool(
            min(count, usable_cores() if threads is None else threads), "simulation"
        )
        self._action_size = action_size
        self._task = np.zeros(count, dtype=np.int64)
        self._begun = np.zeros(count, dtype=bool)
        self._success, self._failure = np.zeros((2, count), dtype=bool)
        self._current: dict[str, np.ndarray] = {}
        sizes = {"state": None if observation == "pixels" else state_size, "joints": joint_size}
        self._make_specs((*frame_shape, 3), action_size, sizes)

    def _make_specs(
        self, frame_shape: Sequence[int], action_size: int, sizes: Mapping[str, int | None]
    ) -> None:
        batch, count = self.batch_size, self.batch_size.numel()
        observation: dict[str, Any] = {
            "task": Categorical(len(self.tasks), shape=batch, dtype=torch.int64),
            "success": Binary(1, shape=torch.Size([*batch, 1]), dtype=torch.bool),
        }
        if self.observation != "state":
            shape = torch.Size(frame_shape)
            observation["pixels"] = Bounded(0, 255, shape=batch + shape, dtype=torch.uint8)
            self._current["pixels"] = np.zeros((count, *shape), np.uint8)
        for key, size in sizes.items():
            if size is not None:
                shape = torch.Size([*batch, size])
                observation[key] = Unbounded(shape=shape, dtype=torch.float32)
                self._current[key] = np.zeros((count, size), np.float32)
        self.observation_spec = Composite(observation, shape=batch)
        # A TransformedEnv passes only entries of the state spec on to `_reset`.
        self.state_spec = Composite({"task": observation["task"].clone()}, shape=batch)
        self.action_spec = Bounded(
            -1.0, 1.0, shape=torch.Size([*batch, action_size]), dtype=torch.float32
        )
        # Not Bounded, which TorchRL's RewardScaling and RewardClipping refuse.
        self.reward_spec = Unbounded(shape=torch.Size([*batch, 1]), dtype=torch.float32)
        flag = Categorical(2, shape=torch.Size([*batch, 1]), dtype=torch.bool)
        flags = {key: flag.clone() for key in ("done", "terminated", "truncated")}
        self.done_spec = Composite(flags, shape=batch)

    def _observe(self) -> dict[str, torch.Tensor]:
        done = self._success | self._failure
        flags = {"success": self._success, "done": done, "terminated": done}
        flags |= {"truncated": np.zeros_like(done)}
        found = {**self._current, "task": self._task}
        found |= {key: flag[:, None] for key, flag in flags.items()}
        # Copies: what was handed out before must not change.
        return {
            key: torch.from_numpy(value.copy()).reshape((*self.batch_size, *value.shape[1:]))
            for key, value in found.items()
        }

    def _record(self, row: int) -> None:
        simulation, current = self.simulations[row], self._current
        if "pixels" in current:
            current["pixels"][row] = checked_frame(simulation, current["pixels"].shape[1:3])
        for key in ("state", "joints"):
            if key in current:
                current[key][row] = checked_numbers(simulation, key, current[key].shape[1])

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        del kwargs
        rows = np.ones(len(self._task), dtype=bool)
        if tensordict is not None:
            reset = tensordict.get("_reset", None)
            if reset is not None:
                rows = reset.reshape(-1).cpu().numpy()
            task = tensordict.get("task", None)
            if task is not None:
                if task.is_floating_point() or task.shape.numel() != len(rows):
                    raise ValueError(
                        f"task must be a whole number for each of {len(rows)} simulations, got "
                        f"{task.dtype} {[*task.shape]}"
                    )
                chosen = task.reshape(-1).cpu().numpy()
                if ((chosen < 0) | (chosen >= len(self.tasks)))[rows].any():
                    raise ValueError(
                        f"task must lie in 0..{len(self.tasks) - 1}, got {chosen.tolist()}"
                    )
                self._task[rows] = chosen[rows]
        for row in np.flatnonzero(rows).tolist():
            self.simulations[row].reset(self.tasks[self._task[row]])
            self._record(row)
        if "executed_action" in self._current:
            self._current["executed_action"][rows] = 0.0
        self._begun |= rows
        self._success[rows] = self._failure[rows] = False
        # With the device, TorchRL does not copy all entries at each step.
        return TensorDict(self._observe(), self.batch_size, self.device)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        rows = ~(self._success | self._failure)
        steps = tensordict.get("_step", None)
        if steps is not None:
            rows = rows & steps.reshape(-1).cpu().numpy()
        action = tensordict.get("action", None)
        if action is None:
            raise missing_key(type(self).__name__, tensordict, ["action"])
        size = self._action_size
        if action.shape != (*self.batch_size, size):
            raise ValueError(f"actions must be {[*self.batch_size, size]}, got {[*action.shape]}")
        if not self._begun[rows].all():
            raise ValueError("there is no episode to step in: reset the environment first")
        actions = action.detach().reshape(-1, size).double().cpu().numpy()
        # Checked for all before any of them moves.
        if not np.isfinite(actions[rows]).all():
            raise ValueError(
                f"an action is {size} finite numbers in [-1, 1], got {actions.tolist()}: if a "
                "policy chose it, learning has diverged, lower its learning rate"
            )
        rewards = np.zeros((len(rows), 1), np.float32)
        self._advance(np.flatnonzero(rows).tolist(), actions.clip(-1.0, 1.0), rewards)
        reward = torch.from_numpy(rewards).reshape(*self.batch_size, 1)
        return TensorDict({**self._observe(), "reward": reward}, self.batch_size, self.device)

    def _advance(
        self, rows: Iterable[int], actions: NDArray[np.float64], rewards: NDArray[np.float32]
    ) -> None:
        """Step simulations in all threads and draw their frames in this one."""
        asked = {row: actions[row] for row in rows}

        def step(row: int) -> Outcome:
            return checked_step(self.simulations[row], asked[row])

        def record(row: int, outcome: Outcome) -> None:
            self._record(row)
            rewards[row] = outcome.success
            self._success[row], self._failure[row] = outcome[:2]
            if "executed_action" in self._current:
                self._current["executed_action"][row] = outcome.executed
            else:
                check_executed(outcome, asked[row])

        try:
            self._threads.each(asked, step, record)
        except BaseException:
            self._begun[[*asked]] = False  # some have moved, and their outcome is lost
            raise

    def frames(self) -> np.ndarray:
        """Return a copy of the frames that were drawn last, uint8 ``[*B, H, W, 3]``.

        Raises:
            ValueError: If frames are not observed.
        """
        if "pixels" not in self._current:
            raise ValueError("there are no frames with observation='state': observe 'both'")
        pixels = self._current["pixels"].copy()
        return pixels.reshape(*self.batch_size, *pixels.shape[1:])

    def close(self, *, raise_if_closed: bool = True) -> None:
        """End the threads, close the simulations and let go of them."""
        self._threads.close()
        while self.simulations:
            self.simulations.pop().close()
        super().close(raise_if_closed=raise_if_closed)

    def _set_seed(self, seed: int | None) -> None:
        seeds = row_seeds(seed, len(self.simulations))
        self.seed_rows(seeds)
        self.seeding = Seeding(tuple(seeds))

    def seed_rows(self, seeds: Sequence[int]) -> None:
        """Set the seeds of the simulations' start states; transforms are not reseeded."""
        for simulation, seed in zip(self.simulations, seeds, strict=True):
            simulation.seed(seed)

    def _arrays(self) -> dict[str, np.ndarray]:
        """Return what checkpoints hold besides the simulations, by name."""
        flags = {"begun": self._begun, "success": self._success, "failure": self._failure}
        return {"task": self._task, **flags}

    def simulation_state(self) -> dict[str, Any]:
        """Return all that the future depends on, for checkpoints.

        Raises:
            NotImplementedError: If the simulation cannot be saved.
        """
        return {
            "tasks": self.tasks,
            "simulations": [simulation.save() for simulation in self.simulations],
            "current": {key: torch.from_numpy(v.copy()) for key, v in self._current.items()},
            **{key: torch.from_numpy(v.copy()) for key, v in self._arrays().items()},
        }

    def load_simulation_state(self, state: dict[str, Any]) -> None:
        """Continue from what `simulation_state` returned.

        Raises:
            ValueError: If it belongs to other simulations.
        """
        if (
            len(state["simulations"]) != len(self.simulations)
            or state["current"].keys() != self._current.keys()
            or self.tasks[: len(state["tasks"])] != tuple(state["tasks"])
        ):
            raise ValueError(
                "the state was saved with another number of simulations, another kind of "
                "observation or other tasks: use the same as it has"
            )
        for simulation, saved in zip(self.simulations, state["simulations"], strict=True):
            simulation.load(saved)
        for key, value in self._arrays().items():
            value[:] = state[key].numpy()
        for key, value in self._current.items():
            value[:] = state["current"][key].numpy()


class RobotEnv(SimulationEnv):
    """One physical robot as an environment: a `SimulationEnv` with a batch of one.

    The robot is a `Simulation` whose methods talk to it:

    - ``reset(task)`` brings it and its objects to a start: by a movement, or by telling a person
      what to do and waiting. It returns once the robot is ready.
    - ``step(action)`` scales the action to the robot's units, keeps the limits of joints, speed and
      workspace, waits for the end of the control period, and returns an `Outcome`: success by a
      function or a person's key, failure where an episode must end, and the action that was
      ``executed``. To stop everything, raise an exception.
    - ``frame()`` returns the camera's frame in the size of the scene.
    - ``seed(seed)`` may do nothing: starts are as a person makes them.

    ``Scene.make_env`` returns a new environment at each call. Training makes one, if the run has no
    tests (``RunConfig.eval_episodes=0``); tests on the robot are episodes of the trained policy.

    Writes, besides what `SimulationEnv` writes, ``"executed_action"`` float32 ``[*B, A]``, that of
    the last step. `Trainer` stores it as the action of the transition.

    Args and errors are those of `SimulationEnv`; a batch of several is refused, too.
    """

    def __init__(self, *args: Any, batch_size: int | Sequence[int] = (), **kwargs: Any) -> None:
        count = as_shape(batch_size, "batch_size").numel()
        if count != 1:
            raise ValueError(
                f"there is one robot, and {count} are asked for: train one seed (seeds=(0,)), "
                "without tests (eval_episodes=0)"
            )
        super().__init__(*args, batch_size=batch_size, **kwargs)
        self.observation_spec["executed_action"] = self.action_spec.clone()
        self._current["executed_action"] = np.zeros((1, self._action_size), np.float32)
