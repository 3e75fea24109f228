"""NICO's tasks as one TorchRL environment, batched over seeds and switching task at each reset."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
from dm_env import TimeStep
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from bgpo_trl.errors import as_shape, missing_key
from bgpo_trl.machine import usable_cores
from bgpo_trl.seeding import Seeding, random_state, row_seeds, set_random_state
from bgpo_trl.threads import RowPool
from suites import nico
from suites.nico.base import (
    STATE_SIZE,
    Environment,
    Observation,
    check_observation,
    check_spread,
)
from suites.nico.rendering import FRAME_HEIGHT, FRAME_WIDTH, FrameRenderer


class NicoEnv(EnvBase):
    """NICO at the table, one simulation per element of the batch.

    All simulations run in this process and share one renderer. Threads step the physics, and the
    caller's thread draws each frame as soon as its simulation has finished; results do not depend
    on the number of threads. The task of an episode is chosen at reset, by the entry
    ``"task"`` of the reset's tensordict. Episodes end on success only: append ``StepCounter(50)``
    for the paper's time limit.

    Writes at reset and step: ``"pixels"`` uint8 ``[*B, 32, 64, 3]`` and/or ``"state"`` float32
    ``[*B, 16]`` (joints (rad), grip and object positions (m)); ``"task"`` int64 ``[*B]``, an index
    into ``tasks``. Reads ``"action"`` float32 ``[*B, 4]`` in [-1, 1]. ``"reward"`` is 1 on success,
    else 0; ``"terminated"`` and ``"done"`` are success, ``"truncated"`` is never set here.

    An optional boolean entry ``"_step"`` ``[*B]`` selects the simulations that advance; the others
    repeat their last observation.

    ``set_seed`` also reaches the transforms of this package, at the next reset (see
    `EpisodeTransform`). A copy, by ``copy.deepcopy`` or ``pickle``, continues as the original
    would, with threads and a renderer of its own. Workers of a ``ParallelEnv`` therefore draw alike
    until the ``ParallelEnv``'s ``set_seed``, which seeds each differently.

    Args:
        tasks: Names of the tasks, in the order of their presentation.
        batch_size: Shape of the batch; an int is the length of a batch of one dimension.
        seed: Seed of the first simulation's starts, from which the others count up; or one for
            each; or None for seeds from the operating system.
        spread: Share of the whole range of start states, from 0 (nominal places) to 1.
        observation: ``"pixels"``, ``"state"`` or ``"both"``.
        threads: Threads for physics, the caller's among them; None takes one for each core.

    Raises:
        ValueError: If a task is unknown or named twice, there are not as many seeds as
            simulations, a seed or the spread is out of range, or there is to be no task,
            simulation or thread.

    Example:
        >>> env = NicoEnv(batch_size=[2], seed=0)
        >>> env.rollout(3)["pixels"].shape
        torch.Size([2, 3, 32, 64, 3])
    """

    def __init__(
        self,
        tasks: Sequence[str] = nico.PAPER_TASKS,
        *,
        batch_size: int | Sequence[int] = (),
        seed: int | Sequence[int] | None = 0,
        spread: float = 1.0,
        observation: Observation = "pixels",
        threads: int | None = None,
    ) -> None:
        super().__init__(batch_size=as_shape(batch_size, "batch_size"), device="cpu")
        check_observation(observation)
        check_spread(spread)
        if threads is not None and threads < 1:
            raise ValueError(f"threads must be at least 1, or None for all cores, got {threads}")
        if not tasks or isinstance(tasks, str):
            raise ValueError(f"tasks must be names such as {nico.PAPER_TASKS}, got {tasks!r}")
        nico.check_tasks(tasks)
        self.tasks = tuple(tasks)
        self.observation = observation
        count = self.batch_size.numel()
        self.seeding: Seeding | None = None  # read by the transforms
        self._environments: list[list[Environment]] = []
        for row_seed in row_seeds(seed, count):
            physics = nico.Physics.from_xml_string(nico.scene_xml())
            random = np.random.RandomState(row_seed)
            self._environments.append(
                [
                    nico.load(
                        task,
                        seed=random,
                        spread=spread,
                        observation="state",  # Frames are drawn here, in one thread.
                        time_limit=float("inf"),
                        physics=physics,
                    )
                    for task in self.tasks
                ]
            )
        self._renderer: FrameRenderer | None = None
        if observation != "state":
            self._renderer = FrameRenderer(self._environments[0][0].physics.model.ptr)
        threads = usable_cores() if threads is None else threads
        self._threads = RowPool(min(count, threads), "physics")
        self._task = np.zeros(count, dtype=np.int64)
        self._current: dict[str, np.ndarray] = {}
        self._done = np.zeros(count, dtype=bool)
        self._make_specs()

    def _make_specs(self) -> None:
        batch = self.batch_size
        observation: dict[str, Any] = {
            "task": Categorical(len(self.tasks), shape=batch, dtype=torch.int64)
        }
        count = batch.numel()
        if self.observation != "state":
            shape = torch.Size([FRAME_HEIGHT, FRAME_WIDTH, 3])
            observation["pixels"] = Bounded(0, 255, shape=batch + shape, dtype=torch.uint8)
            self._current["pixels"] = np.zeros((count, *shape), np.uint8)
        if self.observation != "pixels":
            observation["state"] = Unbounded(
                shape=torch.Size([*batch, STATE_SIZE]), dtype=torch.float32
            )
            self._current["state"] = np.zeros((count, STATE_SIZE), np.float32)
        self.observation_spec = Composite(observation, shape=batch)
        # A TransformedEnv passes only entries of the state spec on to `_reset`.
        self.state_spec = Composite({"task": observation["task"].clone()}, shape=batch)
        self.action_spec = Bounded(-1.0, 1.0, shape=torch.Size([*batch, 4]), dtype=torch.float32)
        # Not Bounded, which TorchRL's RewardScaling and RewardClipping refuse.
        self.reward_spec = Unbounded(shape=torch.Size([*batch, 1]), dtype=torch.float32)
        self.done_spec = Composite(
            {
                key: Categorical(2, shape=torch.Size([*batch, 1]), dtype=torch.bool)
                for key in ("done", "terminated", "truncated")
            },
            shape=batch,
        )

    def _observe(self) -> dict[str, torch.Tensor]:
        # Fresh memory each time: what was handed out before must not change.
        out = {
            key: torch.from_numpy(value.copy()).unflatten(0, self.batch_size)
            if self.batch_size
            else torch.from_numpy(value[0].copy())
            for key, value in self._current.items()
        }
        out["task"] = torch.from_numpy(self._task.copy()).reshape(self.batch_size)
        return out

    def _dones(self) -> dict[str, torch.Tensor]:
        done = torch.from_numpy(self._done.copy()).reshape(*self.batch_size, 1)
        return {"done": done, "terminated": done.clone(), "truncated": torch.zeros_like(done)}

    def _environment(self, row: int) -> Environment:
        return self._environments[row][self._task[row]]

    def _record(self, row: int, timestep: TimeStep) -> None:
        if self._renderer is not None:
            data = self._environment(row).physics.data.ptr
            self._renderer.render(data, out=self._current["pixels"][row])
        if "state" in self._current:
            self._current["state"][row] = timestep.observation["privileged_state"]

    def _advance(self, rows: Iterable[int], actions: np.ndarray, rewards: np.ndarray) -> None:
        """Step simulations in all threads and draw their frames in this one."""

        def step(row: int) -> TimeStep:
            return self._environment(row).step(actions[row])

        def record(row: int, timestep: TimeStep) -> None:
            self._record(row, timestep)
            rewards[row] = timestep.reward
            self._done[row] = timestep.last()

        self._threads.each(rows, step, record)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        del kwargs
        rows = np.ones(len(self._task), dtype=bool)
        if tensordict is not None:
            reset = tensordict.get("_reset", None)
            if reset is not None:
                rows = reset.reshape(-1).numpy()
            task = tensordict.get("task", None)
            if task is not None:
                if task.is_floating_point() or task.shape.numel() != len(rows):
                    raise ValueError(
                        f"task must be a whole number for each of {len(rows)} simulations, got "
                        f"{task.dtype} {[*task.shape]}"
                    )
                chosen = task.reshape(-1).numpy()
                if ((chosen < 0) | (chosen >= len(self.tasks)))[rows].any():
                    raise ValueError(
                        f"task must lie in 0..{len(self.tasks) - 1}, got {chosen.tolist()}"
                    )
                self._task[rows] = chosen[rows]
        for row in np.flatnonzero(rows).tolist():
            self._record(row, self._environment(row).reset())
        self._done[rows] = False
        return TensorDict({**self._observe(), **self._dones()}, self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        rows = ~self._done
        steps = tensordict.get("_step", None)
        if steps is not None:
            rows = rows & steps.reshape(-1).numpy()
        action = tensordict.get("action", None)
        if action is None:
            raise missing_key("NicoEnv", tensordict, ["action"])
        if action.shape != (*self.batch_size, 4):
            raise ValueError(f"actions must be {[*self.batch_size, 4]}, got {[*action.shape]}")
        moving = np.flatnonzero(rows).tolist()
        if any(self._environment(row)._reset_next_step for row in moving):
            raise ValueError("there is no episode to step in: reset the environment first")
        actions = action.detach().reshape(-1, 4).double().numpy()
        # Checked for all before any of them moves.
        if not np.isfinite(actions[rows]).all():
            raise ValueError(
                f"an action is 4 finite numbers in [-1, 1], got {actions.tolist()}: if a policy "
                "chose it, learning has diverged, lower its learning rate"
            )
        rewards = np.zeros((len(rows), 1), np.float32)
        self._advance(moving, actions, rewards)
        reward = torch.from_numpy(rewards).reshape(*self.batch_size, 1)
        return TensorDict({**self._observe(), "reward": reward, **self._dones()}, self.batch_size)

    def frames(self) -> np.ndarray:
        """Return a copy of the frames that were drawn last, uint8 ``[*B, 32, 64, 3]``.

        Raises:
            ValueError: If frames are not observed.
        """
        if "pixels" not in self._current:
            raise ValueError("there are no frames with observation='state': observe 'both'")
        pixels = self._current["pixels"].copy()
        return pixels.reshape(*self.batch_size, *pixels.shape[1:])

    def close(self, *, raise_if_closed: bool = True) -> None:
        """End the threads and free the renderer."""
        self._threads.close()
        if self._renderer is not None:
            self._renderer.close()
        super().close(raise_if_closed=raise_if_closed)

    def _set_seed(self, seed: int | None) -> None:
        seeds = row_seeds(seed, len(self._environments))
        self.seed_rows(seeds)
        self.seeding = Seeding(tuple(seeds))

    def seed_rows(self, seeds: Sequence[int]) -> None:
        """Set the seeds of the simulations' start states; transforms are not reseeded."""
        seeds = row_seeds(seeds, len(self._environments))
        for environments, seed in zip(self._environments, seeds, strict=True):
            # All tasks of a simulation draw from one source.
            environments[0].task.random.seed(seed)

    def simulation_state(self) -> dict[str, Any]:
        """Return all that the future depends on, as tensors: physics, task, random numbers."""
        physics, random = [], []
        for environments in self._environments:
            physics.append(torch.from_numpy(environments[0].physics.get_state()))
            random.append(random_state(environments[0].task.random))
        return {
            "physics": torch.stack(physics),
            "random": random,
            "task": torch.from_numpy(self._task.copy()),
            "done": torch.from_numpy(self._done.copy()),
            "current": {key: torch.from_numpy(v.copy()) for key, v in self._current.items()},
        }

    def load_simulation_state(self, state: dict[str, Any]) -> None:
        """Continue from what `simulation_state` returned.

        Raises:
            ValueError: If it belongs to another number of simulations or kind of observation.
        """
        if len(state["physics"]) != len(self._environments):
            raise ValueError(
                f"the state holds {len(state['physics'])} simulations, this environment has "
                f"{len(self._environments)}: use the same number of seeds"
            )
        if state["current"].keys() != self._current.keys():
            raise ValueError(
                f"the state was saved with the observations {sorted(state['current'])}, this "
                f"environment has {sorted(self._current)}: use the same observation"
            )
        if int(state["task"].max()) >= len(self.tasks):
            raise ValueError(
                f"the state was saved in task {int(state['task'].max())}, this environment has "
                f"{len(self.tasks)} tasks: use the same tasks"
            )
        for row, environments in enumerate(self._environments):
            environments[0].physics.set_state(state["physics"][row].numpy())
            set_random_state(environments[0].task.random, state["random"][row])
            for environment in environments:
                environment._reset_next_step = False
        self._task[:] = state["task"].numpy()
        self._done[:] = state["done"].numpy()
        for key, value in self._current.items():
            value[:] = state["current"][key].numpy()
