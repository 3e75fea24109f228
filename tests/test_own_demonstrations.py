"""Demonstrations without actions, from arrays to a run; in a scene that has no demonstrator."""

import numpy as np
import pytest
import torch

import bgpo_trl
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.data.dataset import load_demonstrations, write_demonstrations
from bgpo_trl.encoders.pretrained import bank_path
from bgpo_trl.encoders.representation import load_representation
from bgpo_trl.encoders.train import train_encoders
from bgpo_trl.scenes import SCENES, find_scene
from bgpo_trl.training import Trainer
from tests.helpers import TINY_ENCODERS, finish
from tests.scenes.dot import SavedDot, scene

TASKS = ("left", "right")


def filmed(n, seed, actions=False):
    """Demonstrations of both tasks."""
    simulation, episodes = SavedDot(), {name: [] for name in TASKS}
    simulation.seed(seed)
    for name, direction in zip(TASKS, (-1.0, 1.0), strict=True):
        for _ in range(n):
            simulation.reset(name)
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
    monkeypatch.setitem(SCENES, "dot", scene(SavedDot, demonstrator=None))

    def make(*, actions=False, with_play=False):
        path = tmp_path / "filmed"
        write_demonstrations(path, filmed(5, 0, actions), scene="dot", held_out_per_task=2)
        weights, play = tmp_path / "dot.safetensors", None
        if with_play:
            movements, options = filmed(4, 2, actions=True), {"held_out_per_task": 1}
            play = write_demonstrations(tmp_path / "play", movements, scene="dot", **options)
        parts, options = (load_demonstrations(path), play), {"tasks": TASKS, "progress": False}
        train_encoders(*parts, weights, tmp_path / "fit", TINY_ENCODERS, scene="dot", **options)
        encoders = load_representation(weights, scene=find_scene("dot"))
        return encoders, DemonstrationBank.load(bank_path(weights), encoder_id=encoders.identity)

    return make


def config_of(make_config, share):
    changes = {"algorithm": {"demonstration_share": share}}
    if not share:
        changes["rl"] = {"proposals": "actor", "imitation": 0.0}
    run = {"scene": "dot", "tasks": TASKS, "task_starts": (0, 2), "episodes": 4, "seeds": (3,)}
    return make_config(**run, **changes)


def test_demonstrations_without_actions_train_encoders_and_runs(
    made, make_config, tmp_path, refused
):
    """But there is no experience of such demonstrations."""
    encoders, bank = made()
    assert encoders.inverse is None and bank.steps is None
    assert bank.tasks == TASKS and len(bank.seen().embedding) == 6

    config, run = config_of(make_config, 0.0), tmp_path / "run"
    finish(Trainer(config, run, bank=bank, encoders=encoders, progress=False))

    assert len((run / "train.csv").read_text().splitlines()) == 1 + 4
    policy = bgpo_trl.load_run(run)
    frames = torch.from_numpy(filmed(1, 1)["right"][0]["pixels"])
    policy.condition(frames)
    assert abs(float(policy.act(frames[0])[0])) <= 1

    config, parts = config_of(make_config, 0.25), {"bank": bank, "encoders": encoders}
    refused(
        lambda: Trainer(config, tmp_path / "shown", **parts),
        "no steps of demonstrations",
        "bgpo-experts",
    )


@pytest.mark.parametrize("source", ["actions", "with_play"])
def test_demonstrations_are_experience_if_they_or_play_have_actions(
    made, make_config, tmp_path, source
):
    encoders, bank = made(**{source: True})
    assert encoders.inverse is not None and bank.steps is not None
    config, run = config_of(make_config, 0.25), tmp_path / "run"
    trainer = finish(Trainer(config, run, bank=bank, encoders=encoders, progress=False))
    assert len(trainer.algorithm.shown)
