"""The robot's joints beside latents, from the simulation to an exported policy."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from bgpo_trl.configs import BGPOConfig
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.data.dataset import load_demonstrations, write_demonstrations
from bgpo_trl.data.lerobot import read_lerobot
from bgpo_trl.data.lerobot_export import write_lerobot
from bgpo_trl.data.recording import record_demonstrations
from bgpo_trl.encoders.train import make_bank, train_encoders
from bgpo_trl.evaluation import Evaluator
from bgpo_trl.experiments.watch import WatchArguments, watch
from bgpo_trl.policy import load_run
from bgpo_trl.scenes import SCENES, StateColumns
from tests.helpers import TINY_ENCODERS, finish
from tests.scenes.dot import TASKS, SavedDot, run_config, scene, trainer_of

CENTER, SCALE = (0.5, 10.0), (2.0, 4.0)


class Jointed(SavedDot):
    """A dot with two joints, of which the second moves twice as fast."""

    def joints(self):
        return np.array([self.place, 10.0 + 2.0 * self.place])


def jointed():
    """Return the dot as a scene with joints."""
    return scene(Jointed, joints=StateColumns(center=CENTER, scale=SCALE))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Recorded demonstrations, and encoders and a bank that were made of them."""
    folder = tmp_path_factory.mktemp("jointed")
    options = {"per_task": 6, "held_out_per_task": 2, "progress": False}
    dataset = record_demonstrations(folder / "demonstrations", scene=jointed(), **options)
    weights = folder / "encoders.safetensors"
    options = {"tasks": TASKS, "scene": jointed(), "progress": False}
    parts = (dataset, None, weights, folder / "fit", TINY_ENCODERS)
    return dataset, *train_encoders(*parts, **options)


@pytest.fixture
def dot(monkeypatch):
    monkeypatch.setitem(SCENES, "dot", jointed())


SMALL = {"warmup_steps": 12, "batch_size": 8, "hidden_sizes": (16,)}
JOINED = {"joints": True, "rl": SMALL, "expert_batch_size": 8, "demonstration_noise": 0.0}


def run(made, folder, name="bgpo", algorithm=JOINED):
    """Return the trainer of a run, after it."""
    return finish(trainer_of(folder, made[1:], run_config(name, algorithm, task_starts=(0, 0))))


def farthest(states, recorded):
    """Return how far the last two features are from the nearest recorded ones, at most."""
    ways = states[..., -2:].flatten(0, 1).unsqueeze(1) - recorded
    return ways.abs().amax(-1).amin(1).max()


def test_joints_are_observed_recorded_and_kept_in_banks(made, tmp_path):
    env = jointed().simulate(TASKS, batch_size=[2], seed=0)
    moves = torch.tensor([[0.2], [-0.4]])
    before = env.reset()
    after = env.step(before.clone().set("action", moves))["next"]
    torch.testing.assert_close(after["joints"] - before["joints"], moves * torch.tensor([0.5, 1]))

    dataset, _, bank = made
    length, read = dataset["length"], dataset["joints"]
    torch.testing.assert_close(read[..., 1], (10 + 2 * read[..., 0]) * (read[..., 1] != 0))
    steps = bank.seen().steps
    for row, (first, n_frames) in enumerate(zip(steps.first, steps.length, strict=True)):
        number = dataset["train"].nonzero().flatten()[row]
        assert n_frames == length[number]
        assert steps.joints[first : first + n_frames].equal(read[number, :n_frames])
    bank.save(tmp_path / "bank.safetensors")
    loaded = DemonstrationBank.load(tmp_path / "bank.safetensors", encoder_id=bank.encoder_id)
    assert loaded.identity == bank.identity
    both = (bank.of_task(1) + loaded.of_task(0)).steps.compact().joints
    assert sorted(both[:, 0].tolist()) == sorted(bank.steps.compact().joints[:, 0].tolist())


def test_joints_of_others_come_by_arrays_and_lerobot(made, tmp_path):
    dataset, *_ = made
    write_lerobot(tmp_path / "lerobot", dataset, tasks=TASKS, fps=5)
    episodes = read_lerobot(tmp_path / "lerobot", joints_key="observation.state")
    options = {"scene": jointed(), "held_out_per_task": 2}
    written = write_demonstrations(tmp_path / "own", episodes, **options)
    n_steps = written["joints"].shape[1]
    assert written["joints"].equal(dataset["joints"][:, :n_steps])
    assert load_demonstrations(tmp_path / "own")["joints"].equal(written["joints"])
    for some in episodes.values():
        for episode in some:
            episode["joints"] = np.degrees(episode["joints"])
    with pytest.warns(
        UserWarning, match="12 of 12 episodes, such as 0 of 'left', have joints farther"
    ):
        write_demonstrations(tmp_path / "degrees", episodes, **options)


def test_replays_hold_joints_as_policies_read_them(made, dot, tmp_path):
    """A step moves the dot by half the action, and its joints by as much and twice as much."""
    algorithm = run(made, tmp_path / "run").algorithm
    played = algorithm.replay.contents(0)[0]
    groups = torch.zeros(2, 32, dtype=torch.int64)
    shown = algorithm.shown.draw(groups)
    imitated = algorithm.shown.draw_actions(groups)
    assert algorithm.in_keys == ["latent_and_joints", "context"]
    recorded = (made[2].steps.joints - torch.tensor(CENTER)) / torch.tensor(SCALE)
    for key in ("latent_and_joints", ("next", "latent_and_joints")):
        assert farthest(shown[key], recorded) < 1e-6
    assert farthest(imitated["latent_and_joints"], recorded) < 1e-6
    moved = played["next", "latent_and_joints"] - played["latent_and_joints"]
    expected = played["action"] * torch.tensor([0.5, 1.0]) / torch.tensor(SCALE)
    torch.testing.assert_close(moved[..., -2:], expected, rtol=0, atol=1e-5)


def test_policies_and_critics_depend_on_joints(made, dot, tmp_path):
    algorithm = run(made, tmp_path / "run").algorithm
    drawn = algorithm.shown.draw(torch.zeros(2, 1, 4, dtype=torch.int64))
    batch = TensorDict(drawn, [2, 1, 4])
    changed = batch.clone()
    changed["latent_and_joints"][..., -1] += 1.0
    loss = algorithm.learner.loss
    values = [loss.values("value_network", data) for data in (batch, changed)]
    assert (values[0] != values[1]).all()
    policy, frame = load_run(tmp_path / "run"), np.full((16, 24, 3), 90, np.uint8)
    policy.condition(np.stack([frame] * 4))
    action = policy.act(frame, [0.5, 11.0])
    assert not np.array_equal(action, policy.act(frame, [-0.5, 9.0]))
    for joints, found in ((None, "nothing"), ([0.5], r"float64 \[1\]"), ([np.nan, 1.0], "float64")):
        with pytest.raises(ValueError, match=f"this policy reads 2 joints, .* got {found}"):
            policy.act(frame, joints)
    with pytest.warns(UserWarning, match="joints are farther .*: in another unit") as warned:
        policy.act(frame, np.degrees([0.5, 11.0]))
    assert warned[0].filename == __file__

    policy.export(tmp_path / "policy.pt2")
    act = torch.export.load(tmp_path / "policy.pt2").module()
    exported = act(torch.from_numpy(frame), torch.tensor([0.5, 11.0]))
    np.testing.assert_allclose(exported.numpy(), action, rtol=0, atol=1e-5)
    assert "left: " in watch(WatchArguments(run=tmp_path / "run"))


@pytest.mark.parametrize("name", ["dist-nll", "maml", "ewc"])
def test_baselines_read_joints_too(made, dot, tmp_path, name):
    changes = {} if name == "ewc" else {"task_batch_size": 8}
    run(made, tmp_path / "run", name, {"joints": True, "rl": SMALL, **changes})
    policy, frame = load_run(tmp_path / "run"), np.full((16, 24, 3), 90, np.uint8)
    differ = []  # Dist-NLL has no policy of a task that was hardly played.
    for task in TASKS:
        policy.condition(np.stack([frame] * 4), task=task)
        read = [policy.act(frame, joints) for joints in ([0.5, 11.0], [-0.5, 9.0])]
        differ.append(not np.array_equal(*read))
    assert any(differ)


def test_what_lacks_joints_is_refused_in_a_line(made, monkeypatch, tmp_path, refused):
    dataset, encoders, bank = made
    begin = partial(trainer_of, tmp_path / "run", config=run_config(algorithm=JOINED))
    monkeypatch.setitem(SCENES, "dot", jointed())
    blind = make_bank(encoders, dataset.exclude("joints"), tasks=TASKS)
    refused(lambda: begin((encoders, blind)), "has no joints of the", "make the bank again")
    other = torch.zeros(len(bank.steps.latent), 3)
    other = replace(bank, steps=replace(bank.steps, joints=other))
    refused(lambda: begin((encoders, other)), "has 3 joints", "make the bank again")
    monkeypatch.setitem(SCENES, "dot", scene(SavedDot))
    refused(lambda: begin((encoders, bank)), "has no joints for policies", "set joints to False")
    test = partial(Evaluator, run_config(algorithm=JOINED), bank.held_out(), episodes=1)
    refused(lambda: test(encoders), "has no joints for policies", "set joints to False")
    frames = np.zeros((3, 16, 24, 3), np.uint8)
    written = {"pixels": frames, "joints": np.zeros((3, 2))}
    options = {"held_out_per_task": 0, "scene": scene()}
    call = partial(write_demonstrations, tmp_path / "own", {"left": [written]}, **options)
    refused(call, "has joints, but the scene 'dot' has none", "omit them")
    with pytest.raises(ValueError, match="joints must be off with state='state'"):
        BGPOConfig(state="state", joints=True)


def test_readings_are_finite_numbers_of_each_frame(made):
    steps = made[2].steps
    for joints in (steps.joints[:-1], steps.joints.double(), steps.joints * np.nan):
        with pytest.raises(ValueError, match="joints of its steps are not finite float32 numbers"):
            replace(steps, joints=joints)
