"""One physical robot, from demonstrations to tests, no simulator: python examples/own_robot.py.

The robot is a stand-in, a point on a rail that numpy draws. It shows what has to be written for a
real one: `PhysicalRobot` talks to the motors and the camera, and asks a person to put things back.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

import bgpo_trl
from bgpo_trl.algorithms import ALGORITHMS
from bgpo_trl.configs import (
    InverseModelConfig,
    RepresentationConfig,
    RunConfig,
    SequenceAutoencoderConfig,
    VAEConfig,
)
from bgpo_trl.data.dataset import write_demonstrations
from bgpo_trl.encoders.train import train_encoders
from bgpo_trl.scenes import SCENES, Outcome, RobotEnv, Scene, Simulation
from bgpo_trl.training import Trainer

OUT, TASKS = Path("runs/own-robot"), ("left", "right")
LARGEST_STEP = 0.2  # limit of the motor; an action of 1 asks for a step of 0.3


class StandIn:
    """Motor, camera and person: replace it by yours."""

    def __init__(self):
        self.place, self.random = 0.0, np.random.default_rng(0)

    def move(self, step):
        self.place = float(np.clip(self.place + step, -1, 1))

    def photo(self):
        photo = np.full((16, 32, 3), 40, np.uint8)
        left = int(14 + 14 * self.place)
        photo[4:12, left : left + 4] = (255, 200, 60)
        return photo

    def person_puts_it_back(self, task):
        """With a real robot: ``input(f"Prepare {task}, then press Enter")``."""
        self.place = float(self.random.uniform(-0.3, 0.3))


class PhysicalRobot(Simulation):
    """The robot as training sees it, see `RobotEnv`."""

    def __init__(self):
        self.device, self.task = StandIn(), TASKS[0]

    def seed(self, seed):
        """Do nothing: a person makes the starts."""

    def reset(self, task):
        self.task = task
        self.device.person_puts_it_back(task)

    def step(self, action):
        step = np.clip(0.3 * action, -LARGEST_STEP, LARGEST_STEP)  # before the motor gets it
        self.device.move(step[0])
        return Outcome(success=self.solved(), executed=step / 0.3)

    def frame(self):
        return self.device.photo()

    def solved(self):
        """With a real robot: a measurement, or a key that a person presses."""
        return self.device.place < -0.9 if self.task == "left" else self.device.place > 0.9


RAIL = SCENES["rail"] = Scene(
    name="rail",
    version="1",
    # Data, encoders and policies of another setup or rate are refused.
    setup={"camera": "over the rail, 16 x 32", "units": "an action of 1 moves by 0.3"},
    tasks=TASKS,
    default_tasks=TASKS,
    make_env=partial(RobotEnv, PhysicalRobot),
    frame_shape=(16, 32),
    action_size=1,
    max_steps=12,
    rate=5.0,
)


def record(task, n):
    """Return demonstrations, here of a person who leads the robot to the goal by hand."""
    robot, episodes = PhysicalRobot(), []
    for seed in range(n):
        random = np.random.default_rng([seed, TASKS.index(task)])
        robot.reset(task)
        frames, actions, success = [robot.frame()], [], False
        while not success:
            asked = random.uniform(0.4, 0.9, size=1) * (1 if task == "right" else -1)
            outcome = robot.step(asked)
            actions.append(outcome.executed)
            frames.append(robot.frame())
            success = outcome.success
        episodes.append({"pixels": np.stack(frames), "action": np.stack(actions)})
    return episodes


def test_on_the_robot(policy, robot, task, demonstration):
    """Return whether the policy succeeds after a demonstration; it is not told the task."""
    policy.condition(demonstration)
    robot.reset(task)
    return any(robot.step(policy.act(robot.frame())).success for _ in range(RAIL.max_steps))


if __name__ == "__main__":
    shown = {task: record(task, 30) for task in TASKS}
    dataset = write_demonstrations(OUT / "demonstrations", shown, scene=RAIL, held_out_per_task=10)
    small = RepresentationConfig(
        vae=VAEConfig(steps=200, batch_size=32),
        lae=SequenceAutoencoderConfig(steps=200, batch_size=32),
        inverse=InverseModelConfig(steps=200),
    )
    encoders, bank = train_encoders(
        dataset,
        None,
        OUT / "encoders.safetensors",
        OUT / "encoders",
        small,
        tasks=TASKS,
        scene=RAIL,
    )
    config = RunConfig(
        scene="rail",
        tasks=TASKS,
        task_starts=(0, 0),
        seeds=(0,),  # there is one robot
        episodes=60,
        eval_episodes=0,  # no tests while it trains
        algorithm=replace(ALGORITHMS["bgpo"].config, max_steps=RAIL.max_steps),
    )
    with Trainer(config, OUT / "run", bank=bank, encoders=encoders) as trainer:
        trainer.run()
    policy, robot = bgpo_trl.load_run(OUT / "run"), PhysicalRobot()
    for task in TASKS:
        held_out = [episode["pixels"] for episode in shown[task][-10:]]
        tests = [test_on_the_robot(policy, robot, task, frames) for frames in held_out]
        print(f"{task}: {sum(tests)} of {len(tests)} tests on the robot succeed")
