"""Log attempts of a scene's demonstrator with noise on its actions, of which many fail.

python benchmarks/studies/log_attempts.py data/log --noise 0.3
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from bgpo_trl.data.dataset import write_logged_episodes
from bgpo_trl.data.recording import perform
from bgpo_trl.experiments.command_line import command_line
from bgpo_trl.scenes import Scene, Simulation, find_scene


@dataclass(frozen=True)
class LogArguments:
    """Logged episodes for `bgpo continual --logged`."""

    path: Annotated[Path, tyro.conf.Positional]
    """Folder of the episodes."""
    scene: str = "nico"
    """Robot with a demonstrator."""
    tasks: tuple[str, ...] = ("push_green_to_white",)
    """Tasks to attempt."""
    episodes: int = 100
    """Attempts at each task."""
    noise: float = 0.5
    """Standard deviation of the noise on each component of an action."""
    seed: int = 2
    """Seed of starts and noise."""


def attempt(
    simulation: Simulation, scene: Scene, task: str, noise: float, seed: int
) -> dict[str, Any]:
    """Return one episode."""
    random = np.random.default_rng(seed)

    def with_noise(demonstrator: Callable[[], np.ndarray]) -> Callable[[], np.ndarray]:
        def act() -> np.ndarray:
            asked = demonstrator() + noise * random.standard_normal(scene.action_size)
            return asked.clip(-1, 1).astype(np.float32).astype(np.float64)  # exact in the log

        return act

    episode, success = perform(scene, simulation, task, seed, seed, with_noise)
    return {**episode, "success": success}


def log_attempts(arguments: LogArguments) -> str:
    """Write the episodes; return how many of each task succeeded."""
    scene = find_scene(arguments.scene)
    env = scene.simulate(arguments.tasks, batch_size=1)
    seeds = np.random.SeedSequence(arguments.seed).generate_state(arguments.episodes).tolist()
    episodes = {
        task: [attempt(env.simulations[0], scene, task, arguments.noise, seed) for seed in seeds]
        for task in arguments.tasks
    }
    env.close()
    write_logged_episodes(arguments.path, episodes, scene=scene)
    solved = {task: sum(one["success"] for one in some) for task, some in episodes.items()}
    return "\n".join(
        f"{task}: {count} of {arguments.episodes} succeed" for task, count in solved.items()
    )


if __name__ == "__main__":
    command_line(log_attempts)
