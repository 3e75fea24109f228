"""Loaded policies act as in the test episodes of their runs."""

import json
import pickle
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import bgpo_trl
from bgpo_trl import training
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.encoders.pretrained import bank_path
from bgpo_trl.encoders.representation import save_representation
from bgpo_trl.policy import LoadedRun
from bgpo_trl.runs.config_file import settings_of
from bgpo_trl.scenes.nico import NICO
from suites import nico
from tests.helpers import edit, finish

pytestmark = pytest.mark.usefixtures("easy_world")
ROOT = Path(__file__).parents[1]
TASKS = nico.PAPER_TASKS
LABELED = ("oracle-demonstrations", "maml-demonstrations", "dist-nll-demonstrations")
NAMES = ("bgpo", "bgpo-single", "without-gwr", "ewc", *LABELED)
every_kind = pytest.mark.parametrize("name", NAMES)


def noise(seed, length):
    """Return random frames, uint8 ``[length, 32, 64, 3]``."""
    return np.random.default_rng(seed).integers(256, size=(length, 32, 64, 3), dtype=np.uint8)


DEMONSTRATIONS = [noise(seed, length) for seed, length in ((1, 9), (2, 14), (3, 51))]


def embed(encoders, frames):
    """Return phi of frames, by the encoders alone."""
    latent = encoders.frame_network.latent(torch.from_numpy(frames))
    with torch.no_grad():
        return encoders.lae.encode(latent, torch.tensor(len(frames)))


@pytest.fixture(scope="module")
def tested_bank(encoders, bank):
    """A bank with one held-out demonstration a task, of which there are frames."""
    phi = torch.stack([embed(encoders, frames) for frames in DEMONSTRATIONS])
    seen = bank.seen()
    return DemonstrationBank(
        torch.cat([seen.embedding, phi]),
        torch.cat([seen.task, torch.arange(3)]),
        torch.cat([seen.train, torch.zeros(3, dtype=torch.bool)]),
        TASKS,
        steps=bank.steps.select(torch.arange(27)),  # those of held-out ones are not read
    )


@pytest.fixture(scope="module")
def trainer_of(encoders, tested_bank, begin, make_config, easy_world, tmp_path_factory):
    """Play a run of each algorithm, with encoders in its directory, once."""
    trainers = {}

    def trainer_of(name):
        if name not in trainers:
            # MAML and Dist-NLL need data of each task.
            config = make_config(name=name, episodes=10 + 6 * (name in LABELED), eval_every=99)
            directory = tmp_path_factory.mktemp(name) / "run"
            weights = directory / "encoders" / "encoders.safetensors"
            save_representation(encoders, weights)
            replace(tested_bank, encoder_id=encoders.identity).save(bank_path(weights))
            trainers[name] = begin(directory, config, bank=tested_bank)
            trainers[name].run()
        return trainers[name]

    return trainer_of


@pytest.fixture
def load(trainer_of):
    def load(name="bgpo", **arguments):
        return bgpo_trl.load_run(trainer_of(name).directory, **arguments)

    return load


@every_kind
def test_a_loaded_policy_acts_as_a_snapshot(trainer_of, load, encoders, name):
    """The replay is loaded only for policies that adapt."""
    algorithm, policy = trainer_of(name).algorithm, load(name, seed=8)
    held = len(algorithm.replay) if name.startswith("maml") else 0
    assert len(policy.algorithm.replay) == held
    task = torch.arange(3)[:, None]
    for number, demonstration in enumerate(DEMONSTRATIONS):
        phi = embed(encoders, demonstration).expand(3, 1, -1)
        snapshot = algorithm.snapshot(1, phi, task, torch.Generator().manual_seed(4))
        policy.condition(
            demonstration, task=TASKS[number], generator=torch.Generator().manual_seed(4)
        )
        for frame in noise(6, 3):
            latent = encoders.frame_network.latent(torch.from_numpy(frame)).clamp(-5, 5)
            expected = snapshot.act(latent.expand(3, 1, 64))[number, 0]
            # Products of stacks of other sizes may round differently.
            torch.testing.assert_close(torch.from_numpy(policy.act(frame)), expected)


@pytest.mark.parametrize("length", [1, 51, 70])
def test_recognition_of_demonstrations_of_any_length(trainer_of, load, encoders, length):
    """Which leaves GWR-B as it is."""
    algorithm, config = trainer_of("bgpo").algorithm, trainer_of("bgpo").config.algorithm
    policy, frames = load(seed=8), noise(9, 70)[:length]
    assert load().episodes == 10
    seen = policy.condition(frames)
    assert torch.allclose(seen.embedding, embed(encoders, frames), atol=1e-6)
    graph = algorithm.gwr.graph(1)
    distance, best = (graph.weights - seen.embedding).norm(dim=-1).min(0)
    assert seen.node == int(graph.node[best])
    assert seen.behavior.equal(graph.weights[best])
    activity = torch.exp(-config.gwr.activity_scale * distance)
    assert seen.activity == pytest.approx(float(activity))
    member = algorithm.groups[1].lookup(seen.embedding)
    assert (seen.group, seen.group_novelty) == (int(member.group), float(member.novelty))
    assert seen.known == (seen.group_novelty <= 1)
    assert policy.act(frames[-1]).shape == (4,)
    assert policy.algorithm.gwr.num_nodes.equal(algorithm.gwr.num_nodes)


_ACT = {
    "pt2": """
import json, sys, numpy as np, torch
files = {"bgpo_trl.json": ""}
act = torch.export.load("policy.pt2", extra_files=files).module()
np.save("actions.npy", [act(torch.from_numpy(frame)).numpy() for frame in np.load("frames.npy")])
print(json.dumps([json.loads(files["bgpo_trl.json"]), "bgpo_trl" in sys.modules]))
""",
    "onnx": """
import json, sys, numpy as np, onnxruntime
session = onnxruntime.InferenceSession("policy.onnx")
np.save("actions.npy", [session.run(None, {"frame": f})[0] for f in np.load("frames.npy")])
about = json.loads(session.get_modelmeta().custom_metadata_map["bgpo_trl.json"])
print(json.dumps([about, "torch" in sys.modules]))
""",
}
"""Programs that save actions for ``frames.npy``, and print metadata and if they need our code."""


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("bgpo", "pt2"),
        ("without-gwr", "pt2"),
        ("dist-nll-demonstrations", "pt2"),
        ("bgpo", "onnx"),
        ("dist-nll-demonstrations", "onnx"),
    ],
)
def test_an_exported_policy_acts_as_before_in_a_process_without_the_package(
    load, tmp_path, name, kind
):
    policy, path, frames = load(name), tmp_path / f"policy.{kind}", noise(7, 3)
    with pytest.raises(ValueError, match="has seen no demonstration"):
        policy.export(path)
    policy.condition(DEMONSTRATIONS[1], task=TASKS[1])
    with pytest.raises(ValueError, match=r"end its name in .pt2 or .onnx"):
        policy.export(tmp_path / "policy")
    policy.export(path)
    np.save(tmp_path / "frames.npy", frames)
    program = [sys.executable, "-c", _ACT[kind]]
    found = subprocess.run(program, cwd=tmp_path, capture_output=True, text=True, check=True)
    about = {"scene": NICO.identity, "rate": 5.0, "tasks": [*TASKS]}
    assert json.loads(found.stdout) == [about, False]
    assert [*tmp_path.glob("policy*")] == [path]
    expected = [policy.act(frame) for frame in frames]
    np.testing.assert_allclose(np.load(tmp_path / "actions.npy"), expected, rtol=0, atol=1e-5)
    assert np.ptp(expected, axis=0).max() > 1e-4  # the frame matters
    if kind == "pt2":  # ONNX refuses them by its types
        act = torch.export.load(path).module()
        with pytest.raises(RuntimeError, match="not implemented for 'Float'"):
            act(torch.from_numpy(frames[0]) / 255)


def test_a_demonstration_longer_than_an_episode_is_warned_of(load):
    policy, film = load(), np.concatenate([DEMONSTRATIONS[1]] * 51)
    with pytest.warns(UserWarning, match=f"has {len(film)} frames, an episode .* at most 51"):
        policy.condition(film)
    policy.condition(film[:51])


def test_a_demonstration_that_seems_blue_first_is_warned_of(load, monkeypatch):
    policy = load()
    monkeypatch.setattr(
        "bgpo_trl.policy.doubt_frames", lambda network, frames: "give them red first"
    )
    with pytest.warns(UserWarning, match="give them red first") as caught:
        policy.condition(DEMONSTRATIONS[1])
    assert caught[0].filename == __file__


def test_onnx_without_the_extra_is_refused_in_one_line(load, tmp_path, monkeypatch):
    policy = load("bgpo")
    policy.condition(DEMONSTRATIONS[1])
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"needs onnx, onnxscript, onnxruntime: pip install"):
        policy.export(tmp_path / "policy.onnx")


def test_an_onnx_model_that_acts_otherwise_is_not_written(load, tmp_path, monkeypatch):
    policy = load("bgpo")
    policy.condition(DEMONSTRATIONS[1])
    monkeypatch.setattr("bgpo_trl.policy._check_onnx", lambda: None)
    monkeypatch.setattr("bgpo_trl.policy._onnx_model", lambda program, about: b"")

    def actions(model):
        return lambda frame: torch.from_numpy(policy.act(frame.numpy())) + 1e-3

    monkeypatch.setattr("bgpo_trl.policy._onnx_actions", actions)
    with pytest.raises(RuntimeError, match="acts otherwise"):
        policy.export(tmp_path / "policy.onnx")
    assert not [*tmp_path.glob("*.onnx")]


def test_frames_of_a_camera_are_cropped_turned_and_resized(load):
    policy = load()
    camera = np.random.default_rng(0).integers(256, size=(2, 96, 160, 3), dtype=np.uint8)
    camera[:, 16:80, 10:138] = camera[:, 16:48, 10:74].repeat(2, 1).repeat(2, 2)
    frames = policy.preprocess(camera[..., ::-1], color="bgr", crop=(16, 10, 64, 128))
    np.testing.assert_array_equal(frames, camera[:, 16:80:2, 10:138:2])
    one = policy.preprocess(camera[0], color="rgb", crop=(16, 10, 64, 128))
    np.testing.assert_array_equal(one, frames[0])
    policy.condition(frames)
    assert policy.act(one).shape == (4,)
    for wrong in (
        {"color": "hsv"},
        {"color": "rgb", "crop": (40, 0, 64, 128)},
        {"color": "rgb", "crop": (-1, 0, 64, 128)},
        {"color": "rgb", "frames": camera[0] / 255},
        {"color": "rgb", "frames": camera[0, ..., :1]},
    ):
        with pytest.raises(ValueError, match=r"color is 'hsv'|exceeds frames|frames are uint8"):
            policy.preprocess(**{"frames": camera, **wrong})


@pytest.mark.parametrize("name", ["bgpo", "maml-demonstrations"])
def test_a_pickled_policy_acts_as_before_and_can_be_conditioned_anew(load, name):
    policy, (frame, *_) = load(name), noise(5, 1)
    unconditioned = pickle.loads(pickle.dumps(policy))
    policy.condition(DEMONSTRATIONS[1], task=TASKS[1])
    copied = pickle.loads(pickle.dumps(policy))
    assert (copied.act(frame) == policy.act(frame)).all()
    for one in (policy, copied, unconditioned):
        one.condition(DEMONSTRATIONS[2], task=TASKS[2])
    for other in (copied, unconditioned):
        assert (other.act(frame) == policy.act(frame)).all()
        kept = ("seed", "episodes", "tasks")
        assert [getattr(other, name) for name in kept] == [getattr(policy, name) for name in kept]


class Remembered:
    """An own algorithm without a replay."""

    needs_replay = False

    def __init__(self, config, **parts):
        self.state = {}

    def state_dict(self):
        return dict(self.state)

    def load_state_dict(self, state):
        self.state = state


def test_an_algorithm_without_a_replay_is_loaded_and_pickled(make_config, encoders, bank):
    learned = {"weight": torch.ones(2)}
    run = LoadedRun.restore(Remembered, make_config(), learned, encoders, bank, [3])
    for loaded in (run, pickle.loads(pickle.dumps(run))):
        assert loaded.algorithm.state["weight"].equal(learned["weight"])


@every_kind
def test_only_algorithms_that_do_not_infer_the_task_need_its_label(load, name):
    policy = load(name)
    if name not in LABELED:
        assert policy.condition(DEMONSTRATIONS[0]).task is None
        return
    for wrong in (None, "juggle"):
        with pytest.raises(ValueError, match="task"):
            policy.condition(DEMONSTRATIONS[0], task=wrong)
    seen = policy.condition(DEMONSTRATIONS[0], task=TASKS[1])
    assert (seen.task, seen.node) == (TASKS[1], None)


def test_arrays_that_are_no_demonstration_or_no_frame_are_refused(load):
    policy, two, frame = load(), noise(0, 2), noise(0, 1)[0]
    with pytest.raises(ValueError, match="has seen no demonstration"):
        policy.act(frame)
    policy.condition(DEMONSTRATIONS[0])
    before = policy.act(frame)
    for wrong in (two[:0], frame, two[..., :2], two.transpose(0, 2, 1, 3), two / 255, None):
        with pytest.raises(ValueError, match=r"uint8 \[T, 32, 64, 3\]"):
            policy.condition(wrong)
    for wrong in (frame[None], frame / 255, frame[:, :-1], []):
        with pytest.raises(ValueError, match=r"uint8 \[32, 64, 3\]"):
            policy.act(wrong)
    with pytest.raises(ValueError, match="reads no joints: give it frames alone"):
        policy.act(frame, [0.0] * 4)
    np.testing.assert_array_equal(policy.act(frame), before)


def rewrite(run, **changes):
    edit(run / "config.json", **changes)


def rewrite_algorithm(run, rl=None, **changes):
    settings = json.loads((run / "config.json").read_text())["algorithm"]
    rewrite(run, algorithm={**settings, "rl": {**settings["rl"], **(rl or {})}, **changes})


def cut_checkpoints(run):
    for path in (run / "checkpoint").iterdir():
        path.write_bytes(path.read_bytes()[:1000])


@pytest.mark.filterwarnings("ignore:.*is damaged")
@pytest.mark.parametrize(
    ("damage", "cause"),
    [
        (shutil.rmtree, "holds no run"),
        (lambda run: shutil.rmtree(run / "checkpoint"), "no intact checkpoint"),
        (cut_checkpoints, "is damaged"),
        (lambda run: shutil.rmtree(run / "encoders"), "trained with the encoders"),
        (lambda run: rewrite(run, encoders="0" * 64), "trained with the encoders 000000000000"),
        (lambda run: rewrite(run, bank="0" * 64), "with the demonstrations 000000000000"),
        (lambda run: rewrite(run, encoders=None), "trained without encoders"),
        (
            lambda run: rewrite_algorithm(run, state="state", beta=0.0),
            "state is latent there and state here",
        ),
        (lambda run: rewrite_algorithm(run, {"hidden_sizes": [2_000_000_000]}), "hidden_sizes is"),
        (lambda run: rewrite(run, name="mine"), "'mine'"),
    ],
)
def test_a_run_that_cannot_be_loaded_is_refused(trainer_of, tmp_path, refused, damage, cause):
    run = tmp_path / "run"
    shutil.copytree(trainer_of("bgpo").directory, run)
    damage(run)
    refused(lambda: bgpo_trl.load_run(run), cause, "")


def test_settings_of_today_that_an_older_run_lacks_are_warned_of(begin, tmp_path, monkeypatch):
    def older(*arguments):
        settings = settings_of(*arguments)
        del settings["algorithm"]["joints"], settings["algorithm"]["rl"]["caution"]
        return settings

    monkeypatch.setattr(training, "settings_of", older)
    finish(begin(tmp_path / "run"))
    with pytest.warns(UserWarning, match="made before there was") as caught:
        bgpo_trl.load_run(tmp_path / "run")
    assert "a setting algorithm.joints, algorithm.rl.caution: " in str(caught[0].message)


def test_a_run_on_the_ground_truth_watches_nothing(
    begin, make_config, encoders, tmp_path, monkeypatch
):
    place = "bgpo_trl.runs.demonstrations.load_representation"
    monkeypatch.setattr(place, lambda path: encoders)
    finish(begin(tmp_path / "run", make_config("state", "ddpg", episodes=1)))
    with pytest.raises(ValueError, match="learned from the ground truth"):
        bgpo_trl.load_run(tmp_path / "run")


@pytest.mark.parametrize("seed", [4, "3"])
def test_a_seed_that_is_not_in_the_run_is_refused(load, seed):
    with pytest.raises(ValueError, match=f"has no seed {seed!r}: choose one of 3, 8"):
        load(seed=seed)


def test_the_package_lists_its_names():
    assert {"TrainedPolicy", "__version__", "load_run"} <= set(dir(bgpo_trl))
    with pytest.raises(AttributeError, match="lode_run"):
        _ = bgpo_trl.lode_run
