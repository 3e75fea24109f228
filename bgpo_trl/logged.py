"""Logged episodes as the first experience of a run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import torch
from torch import Tensor
from torch.nn.functional import one_hot
from torchrl.envs.utils import step_mdp

from bgpo_trl.algorithms import Algorithm
from bgpo_trl.data.logged_episodes import LoggedEnv, LoggedEpisodes
from bgpo_trl.files.progress import progress_bar
from bgpo_trl.seeding import generators
from bgpo_trl.transforms import DemonstrationSource, GroupLookup, TaskSchedule


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

    Raises:
        ValueError: If the algorithm has no replay.
    """
    if getattr(algorithm, "replay", None) is None:
        raise ValueError(
            f"{type(algorithm).__name__} has no replay for logged episodes: leave them out"
        )
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
