"""Demonstrations without actions, from arrays to a run; in a scene that has no demonstrator."""

import bgpo_trl
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.data.dataset import load_demonstrations, write_demonstrations
from bgpo_trl.encoders.pretrained import bank_path
from bgpo_trl.encoders.representation import load_representation
from bgpo_trl.encoders.train import train_encoders
from bgpo_trl.scenes import SCENES, find_scene
from bgpo_trl.training import Trainer
from tests.helpers import TINY_ENCODERS, finish
from tests.scenes.dot import TASKS, SavedDot, record_some, scene


def filmed(folder):
    """Frames of five demonstrations of each task."""
    episodes = {name: [] for name in TASKS}
    for row in record_some(folder, scene(SavedDot), per_task=5):
        pixels = row["pixels"][: int(row["length"])].numpy()
        episodes[TASKS[row["task"]]].append({"pixels": pixels})
    return episodes


def test_demonstrations_without_actions_train_encoders_and_runs(make_config, tmp_path, refused):
    """But there is no experience of such demonstrations."""
    SCENES["dot"], shown = scene(SavedDot, demonstrator=None), filmed(tmp_path / "recorded")
    write_demonstrations(tmp_path / "filmed", shown, scene="dot", held_out_per_task=2)
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
    policy, frames = bgpo_trl.load_run(run), shown["right"][0]["pixels"]
    policy.condition(frames)
    assert abs(float(policy.act(frames[0])[0])) <= 1
    parts = {"bank": bank, "encoders": encoders}
    refused(
        lambda: Trainer(make_config(**changes), tmp_path / "shown", **parts),
        "no steps of demonstrations",
        "bgpo-experts",
    )
