"""Stable-Baselines3 on a NICO task, by Gymnasium: python examples/sb3_on_nico.py --steps 20000.

Needs the extra `gymnasium`. Frames are larger than 32 x 64 for the CNN of Stable-Baselines3.
"""

from __future__ import annotations

import sys

import tyro
from gymnasium import Env
from shimmy import DmControlCompatibilityV0
from stable_baselines3 import SAC
from stable_baselines3.common.base_class import BaseAlgorithm

from suites import nico


def make_env(task: str, seed: int, *, pixels: bool) -> Env:
    """Return a task with Gymnasium's interface; without pixels, it observes the simulation."""
    options = {"observation": "pixels" if pixels else "state", "frame_size": (84, 84)}
    return DmControlCompatibilityV0(nico.load(task, seed=seed, **options))


def success_rate(learner: BaseAlgorithm, env: Env, episodes: int) -> float:
    """Return the share of test episodes, without exploration, that end in success."""
    won = 0.0
    for _ in range(episodes):
        observation, _ = env.reset()
        done, reward = False, 0.0
        while not done:
            action, _ = learner.predict(observation, deterministic=True)
            observation, reward, terminated, truncated, _ = env.step(action)
            done = terminated or truncated
        won += float(reward)  # 1 on success, which ends the episode
    return won / episodes


def main(task: str = "grasp_glass", steps: int = 300, seed: int = 0, pixels: bool = False) -> None:
    """Train SAC and test it.

    Args:
        task: Task to learn.
        steps: Environment steps of training.
        seed: Seed of the start states and of the learner; tests have the next one.
        pixels: Learn from frames instead of the simulation's state.
    """
    env = make_env(task, seed, pixels=pixels)
    learner = SAC("MultiInputPolicy", env, seed=seed, buffer_size=min(steps, 20_000), device="cpu")
    learner.learn(steps)
    rate = success_rate(learner, make_env(task, seed + 1, pixels=pixels), episodes=10)
    print(f"{task}: {rate:.0%} of 10 test episodes succeed after {steps} steps")


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except ValueError as error:
        sys.exit(f"error: {error}")
