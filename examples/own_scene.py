"""A robot of your own, from its simulation to its learning curve: python examples/own_scene.py.

The robot is the two-link arm of dm_control's ``reacher``, seen from above in frames of 48 x 48,
with two joints to move and two tasks: stretch the arm to the left, or to the right. On the command
line, ``--scene reacher --import examples.own_scene`` names it.
"""

from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np
from dm_control import suite

from bgpo_trl.algorithms import ALGORITHMS
from bgpo_trl.configs import (
    InverseModelConfig,
    RepresentationConfig,
    RunConfig,
    SequenceAutoencoderConfig,
    VAEConfig,
)
from bgpo_trl.encoders.train import make_pretrained
from bgpo_trl.evaluation import evaluate_random_policy
from bgpo_trl.runs.results import read_run
from bgpo_trl.scenes import SCENES, Outcome, Scene, Simulation, SimulationEnv
from bgpo_trl.seeding import random_state, set_random_state
from bgpo_trl.training import Trainer
from suites.nico.rendering import FrameRenderer

OUT, TASKS = Path("runs/own-scene"), ("stretch_left", "stretch_right")
STEP, NEAR = 0.2, 0.3  # (rad)


@cache
def renderer():
    """Return the renderer that all simulations share."""
    model = suite.load("reacher", "easy").physics.model
    # Multisampling, shadows and reflections take most of a frame's time and show nothing.
    model.vis.quality.offsamples, model.light_castshadow[:] = 0, 0
    model.mat_reflectance[:] = 0
    # The encoders have to see the arm, which is a pixel wide, rather than the ball.
    model.geom_rgba[model.name2id("target", "geom"), 3] = 0
    for link, color in (("arm", (1.0, 0.8, 0.2, 1.0)), ("hand", (0.3, 0.8, 1.0, 1.0))):
        geom = model.name2id(link, "geom")
        model.geom_size[geom, 0], model.geom_matid[geom] = 0.03, -1
        model.geom_rgba[geom] = color
    model.cam_fovy[model.name2id("fixed", "camera")] = 30
    return FrameRenderer(model.ptr, "fixed", height=48, width=48)


class Reacher(Simulation):
    """The arm, whose joints move by up to 0.2 rad a step."""

    def __init__(self):
        self.random, self.task = np.random.RandomState(0), TASKS[0]
        self.env = suite.load("reacher", "easy", task_kwargs={"random": self.random})
        self.physics = self.env.physics

    def seed(self, seed):
        self.random.seed(seed)

    def reset(self, task):
        self.task = task
        self.env.reset()
        while self.solved():  # Nothing is solved at its start.
            self.env.reset()

    def step(self, action):
        self.physics.data.qpos[:] += STEP * np.clip(action, -1, 1)
        self.physics.forward()
        return Outcome(success=self.solved())

    def solved(self):
        return np.abs(self.way()).max() < NEAR

    def frame(self):
        return renderer().render(self.physics.data.ptr)

    def way(self):
        """Way of the joints to the goal (rad), the shorter one around."""
        goal = np.array([np.pi if self.task == "stretch_left" else 0.0, 0.0])
        return (goal - self.physics.data.qpos + np.pi) % (2 * np.pi) - np.pi

    # With these two, runs can be resumed.
    def save(self):
        return {
            "physics": self.physics.get_state().tolist(),
            "random": random_state(self.random),
            "task": self.task,
        }

    def load(self, state):
        self.physics.set_state(np.array(state["physics"]))
        self.physics.forward()
        set_random_state(self.random, state["random"])
        self.task = state["task"]


def demonstrate(simulation, task, seed):
    """Move straight to the goal, at a speed of its own and with a tremor."""
    random = np.random.default_rng(seed)
    speed = random.uniform(0.5, 1.0)

    def act():
        way = simulation.way() / STEP
        way *= speed / max(np.abs(way).max(), 1e-6, speed)
        return np.clip(way + 0.1 * random.standard_normal(2), -1, 1)

    return act


REACHER = SCENES["reacher"] = Scene(
    name="reacher",
    version="1",  # Change it when frames or movements change: old data no longer fit.
    tasks=TASKS,
    default_tasks=TASKS,
    make_env=partial(SimulationEnv, Reacher),
    frame_shape=(48, 48),
    action_size=2,
    max_steps=25,
    demonstrator=demonstrate,
)

if __name__ == "__main__":
    small = RepresentationConfig(
        vae=VAEConfig(steps=300, batch_size=32),
        lae=SequenceAutoencoderConfig(steps=300, batch_size=64),
        inverse=InverseModelConfig(steps=1_000),
    )
    encoders, bank = make_pretrained(
        OUT / "encoders.safetensors",
        OUT / "demonstrations",
        folder=OUT / "encoders",
        scene=REACHER,
        config=small,
        per_task=200,
        held_out_per_task=20,
    )
    config = RunConfig(
        scene="reacher",
        tasks=TASKS,
        task_starts=(0, 60),
        seeds=(0,),
        episodes=120,
        eval_every=30,
        eval_episodes=10,
        algorithm=replace(ALGORITHMS["bgpo"].config, max_steps=25),
    )
    with Trainer(config, OUT / "run", bank=bank, encoders=encoders, resume=True) as trainer:
        trainer.run()
    by_chance = evaluate_random_policy(tasks=TASKS, episodes=50, max_steps=25, scene=REACHER)
    learned = read_run(OUT / "run").success[0].T  # [tasks, tests]
    for task, chance, curve in zip(TASKS, by_chance, learned, strict=True):
        print(f"{task}: random actions {chance:.0%}, tests of BGPO", *map("{:.0%}".format, curve))
