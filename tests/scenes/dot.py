"""The smallest robot: a dot that moves along a line, one action, frames of 16 x 24."""

from dataclasses import replace
from functools import partial

import numpy as np

from bgpo_trl.algorithms import ALGORITHMS
from bgpo_trl.configs import RunConfig
from bgpo_trl.data.recording import record_demonstrations
from bgpo_trl.encoders.train import make_pretrained
from bgpo_trl.scenes import Outcome, Scene, Simulation, SimulationEnv
from bgpo_trl.seeding import random_state, set_random_state
from bgpo_trl.training import Trainer
from tests.helpers import TINY_ENCODERS

TASKS = ("left", "right")
SHAPE = {"frame_shape": (16, 24), "action_size": 1}


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


def scene(make=Dot, *, env=SimulationEnv, **changes):
    """Return the dot as a scene."""
    options = {
        "tasks": TASKS,
        "default_tasks": TASKS,
        "make_env": partial(env, make),
        "max_steps": 12,
        "demonstrator": demonstrate,
    }
    return Scene(name="dot", version="dot-1", **{**SHAPE, **options, **changes})


def record_some(path, robot, **options):
    """Return two new demonstrations of each task of a scene, one of them held out."""
    options = {"per_task": 2, "held_out_per_task": 1, "progress": False, **options}
    return record_demonstrations(path, scene=robot, **options)


def pretrain(robot, folder, per_task=6):
    """Return encoders and bank of new demonstrations of a scene, two a task held out."""
    return make_pretrained(
        folder / "encoders.safetensors",
        folder / "demonstrations",
        folder=folder / "log",
        scene=robot,
        config=TINY_ENCODERS,
        per_task=per_task,
        held_out_per_task=2,
        progress=False,
    )


def run_config(name="bgpo", algorithm=None, **changes):
    """Return the settings of a run of four episodes, with some of them and the algorithm's changed.

    Those of the algorithm's networks and updates are under ``rl``.
    """
    usual, given = ALGORITHMS[name].config, {"max_steps": 12, **(algorithm or {})}
    rl = replace(usual.rl, **{"warmup_steps": given["max_steps"], **given.pop("rl", {})})
    config = RunConfig(
        scene="dot",
        tasks=TASKS,
        task_starts=(0, 2),
        seeds=(3, 5),
        episodes=4,
        eval_every=2,
        name=name,
        algorithm=replace(usual, rl=rl, **given),
    )
    return replace(config, **changes)


def trainer_of(directory, pretrained, config=None, **options):
    """Return the trainer of a run with these encoders and this bank."""
    encoders, bank = pretrained
    parts = {"bank": bank, "encoders": encoders, "progress": False, **options}
    return Trainer(config or run_config(), directory, **parts)
