"""The smallest robot: a dot that moves along a line, one action, frames of 16 x 24."""

from functools import partial

import numpy as np

from bgpo_trl.scenes import Outcome, Scene, Simulation, SimulationEnv
from bgpo_trl.seeding import random_state, set_random_state


class Dot(Simulation):
    """A dot that is to reach the left or the right edge; it falls off at 1.5."""

    def __init__(self):
        self.random, self.task, self.place = np.random.RandomState(0), "left", 0.0

    def seed(self, seed):
        self.random.seed(seed)

    def reset(self, task):
        self.task, self.place = task, self.random.uniform(-0.3, 0.3)

    def step(self, action):
        self.place += 0.5 * float(action[0])
        toward = self.place if self.task == "right" else -self.place
        return Outcome(bool(toward > 0.7), bool(toward < -1.5))

    def frame(self):
        frame = np.zeros((16, 24, 3), np.uint8)
        left = int(np.clip(10 + 10 * self.place, 0, 20))
        frame[6:10, left : left + 4] = 255
        return frame


class SavedDot(Dot):
    """A dot whose simulation can be saved."""

    def save(self):
        return {"task": self.task, "place": self.place, "random": random_state(self.random)}

    def load(self, state):
        self.task, self.place = state["task"], state["place"]
        set_random_state(self.random, state["random"])


def demonstrate(simulation, task, seed):
    random = np.random.default_rng(seed)
    return lambda: np.array([(0.3 if task == "right" else -0.3) + 0.05 * random.standard_normal()])


def scene(make=Dot, **changes):
    """Return the dot as a scene."""
    return Scene(
        name="dot",
        version="dot-1",
        tasks=("left", "right"),
        default_tasks=("left", "right"),
        make_env=partial(SimulationEnv, make),
        max_steps=12,
        **{"demonstrator": demonstrate, "frame_shape": (16, 24), "action_size": 1, **changes},
    )
