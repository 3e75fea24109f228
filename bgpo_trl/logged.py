"""Logged episodes: earlier attempts at the tasks of a robot, which a run begins with."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Self, cast

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor
from torch.nn.functional import one_hot
from torchrl.envs.utils import step_mdp

from bgpo_trl.algorithms import Algorithm
from bgpo_trl.configs import RunConfig
from bgpo_trl.data.dataset import open_complete, scene_of
from bgpo_trl.files.progress import progress_bar
from bgpo_trl.scenes import Outcome, Scene, Simulation, SimulationEnv
from bgpo_trl.seeding import generators
from bgpo_trl.transforms import DemonstrationSource, GroupLookup, TaskSchedule


@dataclass(frozen=True)
class LoggedEpisodes:
    """Episodes of a dataset of `write_logged_episodes`.

    Attributes:
        path: Its folder.
        episodes: Memory-mapped ``[N]``, as of `record_demonstrations`, with ``success`` bool.
        tasks: Names of the tasks, in the order of their labels.
        scene: Identity of the scene (`Scene.identity`).
        identity: Digest of the episodes and of the names of their tasks.
    """

    path: Path
    episodes: TensorDict
    tasks: tuple[str, ...]
    scene: str
    identity: str

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Open a dataset.

        Raises:
            ValueError: If it is missing, damaged, or has no ``success``.
        """
        path = Path(path)
        episodes, meta = open_complete(path)
        if "success" not in episodes or "action" not in episodes:
            raise ValueError(
                f"{path} does not say which episodes succeeded, with which actions: write them "
                "with write_logged_episodes (docs/extending.md)"
            )
        digest = hashlib.sha256(json.dumps([meta["checksum"], meta["tasks"]]).encode())
        return cls(path, episodes, tuple(meta["tasks"]), scene_of(meta), digest.hexdigest())

    def check(self, config: RunConfig, scene: Scene) -> None:
        """Raise ``ValueError`` unless a run in a scene can learn from the episodes."""
        remedy = "log episodes of this scene, or take a run in that one"
        scene.check_identity(self.scene, self.path, remedy)
        learner, found = config.algorithm, self.episodes
        starts = dict(zip(config.tasks, config.task_starts, strict=True))
        foreign = [task for task in self.tasks if starts.get(task) != 0][:1]
        read = ["joints"] * learner.joints + ["state"] * (learner.state == "state")
        missing = [key for key in read if key not in found]
        action, n_steps = found["action"], found["length"] - 1
        longest, most = int(n_steps.max()), learner.rl.replay_size
        for fits, why in (
            (
                not foreign,
                f"has episodes of {foreign}, no task of the run from its first episode on: write "
                "the others alone, or let it start at 0 (task_starts)",
            ),
            (
                not missing,
                f"has no {missing}, which policies read: write episodes with them, or choose an "
                "algorithm that does not read them",
            ),
            (
                # Comparisons with NaN are false.
                action.shape[-1] == scene.action_size and bool((action.abs() <= 1).all()),
                f"must have actions of {scene.action_size} numbers in [-1, 1]: write it again",
            ),
            (
                longest <= learner.max_steps,
                f"has an episode of {longest} steps, those of the run have {learner.max_steps} at "
                "most: cut it, or raise max_steps",
            ),
            (
                int(n_steps.sum()) <= most,
                f"has {int(n_steps.sum())} steps, the replay holds {most}: raise replay_size, or "
                "write fewer episodes",
            ),
            (
                learner.rl.proposals != "clone",
                f"has episodes to learn from, but {config.name} learns from demonstrations alone: "
                "leave them out, or choose another algorithm",
            ),
        ):
            if not fits:
                raise ValueError(f"{self.path} {why}")


class _Player(Simulation):
    """A robot that repeats a logged episode, whatever it is asked to do."""

    def __init__(self, episodes: TensorDict) -> None:
        self._episodes = episodes
        self.number = self.moment = 0

    def seed(self, seed: int) -> None:
        """Do nothing: nothing is random."""

    def reset(self, task: str) -> None:
        del task
        self.moment = 0

    def step(self, action: NDArray[np.float64]) -> Outcome:
        del action
        self.moment += 1
        ends = self.moment == int(self._episodes["length"][self.number]) - 1
        success = ends and bool(self._episodes["success"][self.number])
        return Outcome(success, ends and not success)

    def frame(self) -> NDArray[np.uint8]:
        return self._read("pixels")

    def state(self) -> NDArray[Any]:
        return self._read("state")

    def joints(self) -> NDArray[Any]:
        return self._read("joints")

    def _read(self, key: str) -> NDArray[Any]:
        return cast(Tensor, self._episodes[key])[self.number, self.moment].numpy()


class LoggedEnv(SimulationEnv):
    """Logged episodes as an environment, the same for all elements of the batch.

    An episode that failed is over as by a time limit, since logs do not say why it ended.

    Args:
        logged: The episodes.
        timeouts_bootstrap: Whether a time limit is ``"truncated"``, and not ``"terminated"``; see
            `AlgorithmConfig`.
        tasks: Names of the tasks, in the order of their numbers.
        options: Further arguments of `SimulationEnv`.
    """

    def __init__(
        self,
        logged: LoggedEpisodes,
        tasks: tuple[str, ...],
        *,
        timeouts_bootstrap: bool = True,
        **options: Any,
    ) -> None:
        super().__init__(partial(_Player, logged.episodes), tasks, threads=1, **options)
        self._timeouts_bootstrap = timeouts_bootstrap

    def select(self, number: int) -> None:
        """Choose the episode that begins at the next reset."""
        for player in cast(list[_Player], self.simulations):
            player.number = number

    def _observe(self) -> dict[str, Tensor]:
        found = super()._observe()
        if not self._timeouts_bootstrap:
            return found
        success = found["success"]
        return {**found, "terminated": success.clone(), "truncated": found["done"] & ~success}


@dataclass(frozen=True)
class _LoggedTasks:
    """Schedule by which each episode has the task of the logged one, int64 ``[N]``."""

    task: Tensor
    n_tasks: int

    def available(self, episode: Tensor) -> Tensor:
        return one_hot(self.task[episode], self.n_tasks).bool()


def replay_logged(algorithm: Algorithm, logged: LoggedEpisodes, *, progress: bool = True) -> None:
    """Store logged episodes in the replay of each seed, before its first episode.

    They go through the transforms of training episodes: frames are encoded; a demonstration of the
    task is drawn from the bank, and GWR-B and groups learn it; the intrinsic reward is added. No
    success is counted, since no policy of the run has played.
    """
    scene, bank, config = algorithm.scene, algorithm.bank, algorithm.config
    batch = torch.Size([algorithm.n_seeds])
    labels = torch.tensor([bank.tasks.index(name) for name in logged.tasks])
    source = DemonstrationSource(
        bank,
        cast(TaskSchedule, _LoggedTasks(labels[logged.episodes["task"]], len(bank.tasks))),
        batch_size=batch,
        generator=generators(algorithm.seeds, "logged"),
    )
    # Logs need no joints if policies do not read them.
    joint_size = None if algorithm.joints is None else algorithm.joints.size
    sizes: dict[str, Any] = {**scene.sizes, "joint_size": joint_size}
    simulation = LoggedEnv(
        logged,
        bank.tasks,
        timeouts_bootstrap=config.timeouts_bootstrap,
        **sizes,
        batch_size=batch,
        observation="pixels" if config.state == "latent" else "state",
    )
    env = algorithm.make_env(simulation, source)
    for part in env.modules():
        if isinstance(part, GroupLookup):
            part.tries = False
    lengths = logged.episodes["length"].tolist()
    for number in progress_bar("logged", range(len(lengths)), shown=progress, unit="episode"):
        simulation.select(number)
        state = env.reset()
        for action in logged.episodes["action"][number, : lengths[number] - 1]:
            state["action"] = action.repeat(len(algorithm.seeds), 1)
            transition = env.step(state)
            algorithm.store_logged(transition)
            state = step_mdp(transition)
    env.close()
