"""Demonstrations without actions, from arrays to a run; in a scene that has no demonstrator."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import bgpo_trl
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.data.dataset import load_demonstrations
from bgpo_trl.data.writing import write_demonstrations
from bgpo_trl.encoders.pretrained import bank_path
from bgpo_trl.encoders.representation import load_representation
from bgpo_trl.encoders.train import train_encoders
from bgpo_trl.scenes import SCENES, Outcome, Scene, Simulation, SimulationEnv
from bgpo_trl.training import Trainer
from tests.helpers import TINY_ENCODERS

TASKS = ("left", "right")


class Slider(Simulation):
    """A bright column that an action of one component moves to the left or right edge."""

    def __init__(self, tasks):
        self.tasks = tasks

    def seed(self, seed):
        self.random = np.random.default_rng(seed)

    def reset(self, task):
        self.task, self.place = self.tasks[task], self.random.uniform(6, 18)

    def step(self, action):
        self.place = float(np.clip(self.place + 4 * action[0], 0, 23))
        return Outcome(self.place < 1 if self.task == "left" else self.place > 22)

    def frame(self):
        frame = np.full((16, 24, 3), 40, np.uint8)
        frame[:, round(self.place)] = 220
        return frame

    def save(self):
        return {"task": self.task, "place": self.place, "random": self.random.bit_generator.state}

    def load(self, state):
        self.task, self.place = state["task"], state["place"]
        self.random.bit_generator.state = state["random"]


def simulate(tasks, **options):
    return SimulationEnv(
        lambda: Slider(tasks),
        tasks,
        frame_shape=(16, 24),
        action_size=1,
        state_size=None,
        **options,
    )


SLIDER = Scene(
    name="slider",
    version="slider-1",
    tasks=TASKS,
    default_tasks=TASKS,
    make_env=simulate,
    frame_shape=(16, 24),
    action_size=1,
    max_steps=6,
)


def filmed(n, seed, actions=False):
    """Demonstrations of both tasks."""
    simulation, episodes = Slider(TASKS), {name: [] for name in TASKS}
    simulation.seed(seed)
    for task, (name, direction) in enumerate(zip(TASKS, (-1.0, 1.0), strict=True)):
        for _ in range(n):
            simulation.reset(task)
            frames, steps, success = [simulation.frame()], [], False
            while not success:
                steps.append([direction * simulation.random.uniform(0.4, 0.6)])
                success = simulation.step(steps[-1]).success
                frames.append(simulation.frame())
            episode = {"pixels": np.stack(frames)}
            episodes[name].append({**episode, "action": steps} if actions else episode)
    return episodes


@pytest.fixture
def made(tmp_path, monkeypatch):
    """Encoders and bank of demonstrations, without actions unless asked for, read from files."""
    monkeypatch.setitem(SCENES, "slider", SLIDER)

    def make(*, actions=False, with_play=False):
        path = tmp_path / "filmed"
        write_demonstrations(path, filmed(5, 0, actions), scene="slider", held_out_per_task=2)
        weights, play = tmp_path / "slider.safetensors", None
        if with_play:
            movements = filmed(4, 2, actions=True)
            play = write_demonstrations(
                tmp_path / "play", movements, scene="slider", held_out_per_task=1
            )
        train_encoders(
            load_demonstrations(path),
            play,
            weights,
            tmp_path / "fit",
            TINY_ENCODERS,
            progress=False,
            tasks=TASKS,
            scene="slider",
        )
        encoders = load_representation(weights, scene_version="slider-1")
        return encoders, DemonstrationBank.load(bank_path(weights), encoder_id=encoders.identity)

    return make


def config_of(make_config, share):
    config = make_config(scene="slider", tasks=TASKS, task_starts=(0, 2), episodes=4, seeds=(3,))
    return replace(config, algorithm=replace(config.algorithm, demonstration_share=share))


def test_demonstrations_without_actions_train_encoders_and_runs(made, make_config, tmp_path):
    encoders, bank = made()
    assert encoders.inverse is None and bank.steps is None
    assert bank.tasks == TASKS and len(bank.seen().embedding) == 6

    config, run = config_of(make_config, 0.0), tmp_path / "run"
    with Trainer(config, run, bank=bank, encoders=encoders, progress=False) as trainer:
        trainer.run()

    assert len((run / "train.csv").read_text().splitlines()) == 1 + 4
    policy = bgpo_trl.load_run(run)
    frames = torch.from_numpy(filmed(1, 1)["right"][0]["pixels"])
    policy.condition(frames)
    assert abs(float(policy.act(frames[0])[0])) <= 1


def test_without_actions_there_is_no_experience_of_demonstrations(
    made, make_config, tmp_path, refused
):
    encoders, bank = made()
    config = config_of(make_config, 0.25)
    refused(
        lambda: Trainer(config, tmp_path / "run", bank=bank, encoders=encoders, progress=False),
        "no steps of demonstrations",
        "set demonstration_share to 0",
    )


@pytest.mark.parametrize("source", ["actions", "with_play"])
def test_demonstrations_are_experience_if_they_or_play_have_actions(
    made, make_config, tmp_path, source
):
    encoders, bank = made(**{source: True})
    assert encoders.inverse is not None and bank.steps is not None
    config, run = config_of(make_config, 0.25), tmp_path / "run"
    with Trainer(config, run, bank=bank, encoders=encoders, progress=False) as trainer:
        trainer.run()
        assert len(trainer.algorithm.shown)
