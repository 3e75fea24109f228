"""Show a trained policy one demonstration, and let it solve the task from another start.

python examples/one_shot.py runs/continual-bgpo-quick --task push_green_to_glass
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import tyro

import bgpo_trl
from suites import nico
from suites.nico.demonstrator import Demonstrator


def demonstrate(task: str, seed: int) -> np.ndarray:
    """Return the frames of a demonstration of the task, uint8 ``[T, 32, 64, 3]``."""
    env = nico.load(task, seed=seed)
    demonstrator = Demonstrator(env, seed=seed)
    timestep = env.reset()
    demonstrator.reset()
    frames = [timestep.observation["pixels"]]
    while not timestep.last():
        timestep = env.step(demonstrator(timestep))
        frames.append(timestep.observation["pixels"])
    return np.stack(frames)


def main(run: tyro.conf.Positional[Path], task: str = nico.PAPER_TASKS[0], seed: int = 1) -> None:
    """Run the example.

    Args:
        run: Directory of a finished run of BGPO.
        task: Task to demonstrate; the policy does not get its label.
        seed: Seed of the demonstration's start; the policy starts from the next seed.
    """
    policy = bgpo_trl.load_run(run)
    print(policy.condition(demonstrate(task, seed)))

    env = nico.load(task, seed=seed + 1)
    timestep = env.reset()
    while not timestep.last():
        timestep = env.step(policy.act(timestep.observation["pixels"]))
    print(f"{task}: {'success' if timestep.reward else 'no success'}")


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except (ValueError, OSError, RuntimeError) as error:
        sys.exit(f"error: {error}")
