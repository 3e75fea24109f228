"""Demonstrations without actions, from arrays to a run; in a scene that has no demonstrator."""

import numpy as np

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


def filmed(n):
    """Demonstrations of both tasks."""
    simulation, episodes = SavedDot(), {name: [] for name in TASKS}
    for name, direction in zip(TASKS, (-1.0, 1.0), strict=True):
        for _ in range(n):
            simulation.reset(name)
            frames, success = [simulation.frame()], False
            while not success:
                success = simulation.step([direction * simulation.random.uniform(0.4, 0.6)]).success
                frames.append(simulation.frame())
            episodes[name].append({"pixels": np.stack(frames)})
    return episodes


def test_demonstrations_without_actions_train_encoders_and_runs(make_config, tmp_path, refused):
    """But there is no experience of such demonstrations."""
    SCENES["dot"] = scene(SavedDot, demonstrator=None)
    write_demonstrations(tmp_path / "filmed", filmed(5), scene="dot", held_out_per_task=2)
    weights, options = tmp_path / "dot.safetensors", {"tasks": TASKS, "progress": False}
    parts = (load_demonstrations(tmp_path / "filmed"), None, weights, tmp_path / "fit")
    train_encoders(*parts, TINY_ENCODERS, scene="dot", **options)
    encoders = load_representation(weights, scene=find_scene("dot"))
    bank = DemonstrationBank.load(bank_path(weights), encoder_id=encoders.identity)
    assert encoders.inverse is None and bank.steps is None
    assert bank.tasks == TASKS and len(bank.seen().embedding) == 6

    changes = {"scene": "dot", "tasks": TASKS, "task_starts": (0, 2), "episodes": 4, "seeds": (3,)}
    unshown = {
        "algorithm": {"demonstration_share": 0.0},
        "rl": {"proposals": "actor", "imitation": 0.0},
    }
    config, run = make_config(**changes, **unshown), tmp_path / "run"
    finish(Trainer(config, run, bank=bank, encoders=encoders, progress=False))

    assert len((run / "train.csv").read_text().splitlines()) == 1 + 4
    policy, frames = bgpo_trl.load_run(run), filmed(1)["right"][0]["pixels"]
    policy.condition(frames)
    assert abs(float(policy.act(frames[0])[0])) <= 1
    parts = {"bank": bank, "encoders": encoders}
    refused(
        lambda: Trainer(make_config(**changes), tmp_path / "shown", **parts),
        "no steps of demonstrations",
        "bgpo-experts",
    )
