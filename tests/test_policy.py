"""Loaded policies act as in the test episodes of their runs."""

import json
import runpy
import shutil
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch

import bgpo_trl
from bgpo_trl.algorithms import ALGORITHMS
from bgpo_trl.algorithms.policy import Policy
from bgpo_trl.configs import RepresentationConfig
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.encoders.representation import save_representation
from bgpo_trl.encoders.shipped import bank_path
from bgpo_trl.evaluation import Evaluator
from bgpo_trl.training import Trainer
from bgpo_trl.transforms import TaskSchedule
from suites import nico
from suites.nico import nico as suite_nico
from tests.folders import contents

pytestmark = pytest.mark.usefixtures("easy_world")
ROOT = Path(__file__).parents[1]
TASKS = nico.PAPER_TASKS
NAMES = [name for name in ALGORITHMS if name not in ("without-bonus", "without-both")]
LABELED = [name for name in NAMES if name.startswith(("maml", "dist-nll", "oracle"))]
METADATA = {
    "scene_version": nico.scene_version(),
    "config": json.dumps(asdict(RepresentationConfig())),
}
every_algorithm = pytest.mark.parametrize("name", NAMES)


def noise(seed, length):
    """Frames that show nothing, but each something else."""
    return np.random.default_rng(seed).integers(256, size=(length, 32, 64, 3), dtype=np.uint8)


DEMONSTRATIONS = [noise(seed, length) for seed, length in ((1, 9), (2, 14), (3, 51))]


def embed(encoders, frames):
    """Returns phi of frames, by the encoders alone."""
    latent = encoders.vae.latent(torch.from_numpy(frames))
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
        steps=bank.steps.select(torch.arange(27)),  # those of held-out ones are not read
    )


@pytest.fixture(scope="module")
def trainer_of(encoders, tested_bank, make_config, easy_world, tmp_path_factory):
    """Plays a run with encoders of its own to its end, once."""
    trainers = {}

    def trainer_of(name):
        if name not in trainers:
            config = make_config(name=name, episodes=16)
            directory = tmp_path_factory.mktemp(name) / "run"
            weights = directory / "encoders" / "nico.safetensors"
            save_representation(replace(encoders, metadata=METADATA), weights)
            replace(tested_bank, encoder_id=encoders.identity).save(bank_path(weights))
            trainers[name] = Trainer(
                config,
                directory,
                bank=tested_bank,
                encoders=encoders,
                progress=False,
            )
            trainers[name].run()
        return trainers[name]

    return trainer_of


@pytest.fixture
def load(trainer_of):
    def load(name="bgpo", **arguments):
        return bgpo_trl.load_run(trainer_of(name).directory, **arguments)

    return load


@every_algorithm
def test_it_acts_as_the_run_does_in_its_test_episodes(
    trainer_of, load, encoders, tested_bank, monkeypatch, name
):
    trainer = trainer_of(name)
    algorithm, config = trainer.algorithm, trainer.config
    evaluator = Evaluator(
        config.algorithm,
        seeds=config.seeds,
        schedule=TaskSchedule(config.task_starts),
        episodes=1,
        bank=tested_bank.held_out(),
        encoders=encoders,
    )
    drawn, actions, frames = [], [], []
    snapshot, act = algorithm.snapshot, Policy.act

    def spy(index, embedding, task, generator):
        drawn.append(generator.get_state())
        return snapshot(index, embedding, task, generator)

    def acting(policy, state):
        actions.append(act(policy, state))
        return actions[-1]

    monkeypatch.setattr(algorithm, "snapshot", spy)
    monkeypatch.setattr(Policy, "act", acting)
    snapshots = [evaluator.snapshot(algorithm, index, 5, episode=16) for index in range(2)]
    evaluator.run(snapshots, watch=lambda: frames.append(evaluator.simulation.frames()))
    monkeypatch.undo()
    assert len(actions) > 1
    for index, seed in enumerate(config.seeds):
        policy = load(name, seed=seed)
        for task, demonstration in enumerate(DEMONSTRATIONS):
            generator = torch.Generator()
            generator.set_state(drawn[index])
            policy.condition(demonstration, task=TASKS[task], generator=generator)
            for frame, action in zip(frames, actions, strict=False):
                acted = policy.act(frame[index, task, 0])
                assert acted.dtype == np.float32
                # Encoded one by one, a frame's latent differs from that in a batch by rounding.
                np.testing.assert_allclose(acted, action[index, task, 0].numpy(), atol=1e-5)


@every_algorithm
def test_it_acts_exactly_as_the_frozen_policy_of_the_run(trainer_of, load, encoders, name):
    algorithm, policy = trainer_of(name).algorithm, load(name, seed=8)
    task = torch.arange(3)[:, None]
    for number, demonstration in enumerate(DEMONSTRATIONS):
        phi = embed(encoders, demonstration).expand(3, 1, -1)
        snapshot = algorithm.snapshot(1, phi, task, torch.Generator().manual_seed(4))
        both = Policy.stack([snapshot] * 2)
        policy.condition(
            demonstration, task=TASKS[number], generator=torch.Generator().manual_seed(4)
        )
        for frame in noise(6, 3):
            latent = encoders.vae.latent(torch.from_numpy(frame)).clamp(-5, 5)
            expected = both.act(latent.expand(2, 3, 1, 64))[1, number, 0]
            assert torch.from_numpy(policy.act(frame)).equal(expected)


@pytest.mark.parametrize("name", [name for name in NAMES if name not in ("ddpg", *LABELED)])
def test_what_it_is_shown_decides_what_it_does(load, encoders, name):
    policy, (frame,) = load(name), noise(0, 1)
    dark, bright = (np.full((20, 32, 64, 3), shade, np.uint8) for shade in (0, 255))
    if policy.algorithm.gwr is not None:  # So short a run has not learned to tell these apart.
        graphs = policy.algorithm.gwr.get_extra_state()
        for graph in graphs:
            graph["weights"][:2] = torch.stack([embed(encoders, dark), embed(encoders, bright)])
        policy.algorithm.gwr.set_extra_state(graphs)
    actions = []
    for shown in (dark, bright, dark):
        policy.condition(shown)
        actions.append(policy.act(frame))
    assert np.abs(actions[0] - actions[1]).max() > 1e-4
    np.testing.assert_array_equal(actions[0], actions[2])


@pytest.mark.parametrize("length", [1, 2, 20, 51, 70])
def test_a_demonstration_may_have_any_length(trainer_of, load, encoders, length):
    policy, frames = load(seed=8), noise(9, 70)[:length]
    seen = policy.condition(frames)
    assert torch.allclose(seen.embedding, embed(encoders, frames), atol=1e-6)
    graph = trainer_of("bgpo").algorithm.gwr.graph(1)
    distance, best = (graph.weights - seen.embedding).norm(dim=-1).min(0)
    assert seen.node == int(graph.node[best])
    assert seen.behavior.equal(graph.weights[best])
    scale = trainer_of("bgpo").config.algorithm.gwr.activity_scale
    assert seen.activity == pytest.approx(float(torch.exp(-scale * distance)))
    groups = trainer_of("bgpo").algorithm.groups
    member = groups.lookup(seen.embedding.expand(2, -1))[1]
    assert (seen.group, seen.group_novelty) == (int(member.group), float(member.novelty))
    assert seen.known == (seen.group_novelty <= 1)
    assert repr(seen).startswith(f"Recognition(node={seen.node}, activity=")
    assert policy.act(frames[-1]).shape == (4,)


def test_frames_may_be_lists_tensors_views_and_read_only(load):
    policy, frames = load(), noise(9, 8)
    expected = policy.condition(frames[::-1].copy()).embedding
    read_only = frames[::-1].copy()
    read_only.flags.writeable = False
    for same in (frames[::-1], list(frames[::-1]), read_only, torch.tensor(read_only.copy())):
        assert policy.condition(same).embedding.equal(expected)


@every_algorithm
def test_only_those_who_do_not_infer_the_task_need_its_label(load, name):
    policy = load(name)
    if name not in LABELED:
        assert policy.condition(DEMONSTRATIONS[0]).task is None
        return
    with pytest.raises(ValueError, match=f"^{name} does not infer the task: name it") as error:
        policy.condition(DEMONSTRATIONS[0])
    assert "\n" not in str(error.value)
    seen = policy.condition(DEMONSTRATIONS[0], task=TASKS[1])
    assert (seen.task, seen.node) == (TASKS[1], None)


def test_the_label_decides_where_it_is_told(load):
    (frame,) = noise(0, 1)
    for name in LABELED:
        policy, actions = load(name), []
        for task in TASKS:
            policy.condition(DEMONSTRATIONS[0], task=task)
            actions.append(policy.act(frame))
        assert np.abs(actions[0] - actions[1]).max() > 1e-5, name


def test_what_is_not_needed_is_not_loaded(trainer_of, load):
    for name in NAMES:
        held = len(trainer_of(name).algorithm.replay)
        assert len(load(name).algorithm.replay) == (held if "maml" in name else 0) < held + 1


def test_the_run_is_left_as_it_is(trainer_of, load):
    run = trainer_of("bgpo").directory
    before = contents(run)
    policy = load()
    nodes = policy.algorithm.gwr.num_nodes
    for frames in DEMONSTRATIONS:
        policy.condition(frames)
    policy.act(frames[0])
    assert policy.algorithm.gwr.num_nodes.equal(nodes)
    assert contents(run) == before


def test_nothing_is_done_before_something_was_shown(load):
    with pytest.raises(
        ValueError, match=r"has seen no demonstration: show it one with condition\(\)"
    ):
        load().act(noise(0, 1)[0])


@pytest.mark.parametrize(
    ("frames", "said"),
    [
        (noise(0, 1)[:0], r"uint8 \[T, 32, 64, 3\], T at least 1, got uint8 \[0, 32, 64, 3\]"),
        (noise(0, 1)[0], r"got uint8 \[32, 64, 3\]"),
        (noise(0, 2)[:, :, :, :2], r"got uint8 \[2, 32, 64, 2\]"),
        (noise(0, 2).transpose(0, 2, 1, 3), r"got uint8 \[2, 64, 32, 3\]"),
        (noise(0, 2) / 255, r"got float64 \[2, 32, 64, 3\]"),
        (np.full((2, 32, 64, 3), np.nan, np.float32), r"got float32 \[2, 32, 64, 3\]"),
        ([], r"got float64 \[0\]"),
        (None, r"got object \[\]"),
    ],
)
def test_what_is_no_demonstration_is_refused(load, frames, said):
    policy, (frame,) = load(), noise(0, 1)
    policy.condition(DEMONSTRATIONS[0])
    before = policy.act(frame)
    with pytest.raises(ValueError, match=said) as error:
        policy.condition(frames)
    assert "\n" not in str(error.value)
    np.testing.assert_array_equal(policy.act(frame), before)


@pytest.mark.parametrize("frame", [noise(0, 1), noise(0, 1)[0] / 255, noise(0, 1)[0, :, :-1], []])
def test_what_is_no_frame_is_refused(load, frame):
    policy = load()
    policy.condition(DEMONSTRATIONS[0])
    with pytest.raises(ValueError, match=r"^a frame is uint8 \[32, 64, 3\], got"):
        policy.act(frame)


def test_an_unknown_task_is_refused(load):
    with pytest.raises(ValueError, match=r"^no task 'juggle' in this run; choose one of grasp"):
        load("oracle").condition(DEMONSTRATIONS[0], task="juggle")


class AtOnce(nico.NicoTask):
    """Done with the first step, whatever it is."""

    def succeeded(self, physics):
        return physics.time() > 0


def test_a_run_of_own_tasks_is_loaded_where_the_task_is_known(
    encoders, bank, make_config, tmp_path
):
    nico.add_task("at_once", AtOnce)
    tasks = ("at_once", TASKS[1])
    own = replace(bank, tasks=("at_once", *TASKS[1:]))
    config = make_config(tasks=tasks, task_starts=(0, 2), episodes=4)
    run = tmp_path / "run"
    weights = run / "encoders" / "nico.safetensors"
    save_representation(replace(encoders, metadata=METADATA), weights)
    with Trainer(config, run, bank=own, encoders=encoders, progress=False) as trainer:
        trainer.run()
    policy = bgpo_trl.load_run(run)
    assert (policy.tasks, policy.bank.tasks) == (tasks, tasks)
    assert policy.bank.identity == own.for_tasks(tasks).identity
    assert policy.condition(DEMONSTRATIONS[0], task="at_once").task == "at_once"

    suite_nico._TASKS.pop("at_once")
    said = f"the task 'at_once', added by the module {AtOnce.__module__!r}: name a module"
    with pytest.raises(ValueError, match=said):
        bgpo_trl.load_run(run)


def spoil_encoders(run):
    shutil.rmtree(run / "encoders")


def spoil_checkpoints(run):
    for path in (run / "checkpoint").iterdir():
        path.write_bytes(path.read_bytes()[:1000])


def rewrite(run, **changes):
    path = run / "config.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def widen(run):
    algorithm = json.loads((run / "config.json").read_text())["algorithm"]
    rewrite(run, algorithm={**algorithm, "rl": {**algorithm["rl"], "hidden_sizes": [32]}})


def see_the_truth(run):
    algorithm = json.loads((run / "config.json").read_text())["algorithm"]
    rewrite(run, algorithm={**algorithm, "state": "state"})


@pytest.mark.filterwarnings("ignore:.*is damaged")
@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (shutil.rmtree, r"run holds no run: there is no config.json$"),
        (lambda run: shutil.rmtree(run / "checkpoint"), "has no checkpoint: let the run reach"),
        (spoil_checkpoints, "is damaged, and older checkpoints have learned less: resume the run"),
        (spoil_encoders, r"was trained with the encoders \w{12}, not with those that come with"),
        (lambda run: rewrite(run, encoders="0" * 64), "trained with the encoders 000000000000, no"),
        (lambda run: rewrite(run, bank="0" * 64), "with the demonstrations 000000000000, not with"),
        (lambda run: rewrite(run, encoders=None), "learned from the ground truth"),
        (see_the_truth, "learned from the ground truth"),
        (widen, r"checkpoint does not fit .*config.json \(.*\): use the version of the code"),
        (lambda run: rewrite(run, seeds=[3, 8, 9]), r"checkpoint does not fit"),
        (lambda run: rewrite(run, name="mine"), "of 'mine', which is not in ALGORITHMS: name t"),
    ],
)
def test_what_cannot_be_loaded_is_refused_in_a_line(trainer_of, tmp_path, spoil, said):
    run = tmp_path / "run"
    shutil.copytree(trainer_of("bgpo").directory, run)
    bgpo_trl.load_run(run)
    spoil(run)
    with pytest.raises(ValueError, match=said) as error:
        bgpo_trl.load_run(run)
    assert "\n" not in str(error.value)


def test_a_policy_tells_how_long_it_has_learned(load):
    assert min(load().episodes, load(seed=8).episodes) == 16


@pytest.mark.parametrize("seed", [0, -1, 4, "3", 3.5])
def test_another_seed_than_the_run_has_is_refused(load, seed):
    with pytest.raises(ValueError, match=r"has no seed .*: choose one of 3, 8$"):
        load(seed=seed)


def test_the_first_seed_is_the_default(load):
    policies = [load(), load(seed=3), load(seed=8)]
    (frame,) = noise(0, 1)
    for policy in policies:
        policy.condition(DEMONSTRATIONS[0])
    first, same, other = (policy.act(frame) for policy in policies)
    np.testing.assert_array_equal(first, same)
    assert np.abs(first - other).max() > 1e-4


def test_the_example_tells_what_the_policy_saw_and_how_it_went(trainer_of, capsys):
    example = runpy.run_path(str(ROOT / "examples" / "one_shot.py"))
    frames = example["demonstrate"]("push_green_to_white", 4)
    assert frames.dtype == np.uint8 and len(frames) > 10
    example["main"](trainer_of("bgpo").directory, task="push_green_to_white", seed=4)
    seen, outcome = capsys.readouterr().out.splitlines()
    assert seen == repr(bgpo_trl.load_run(trainer_of("bgpo").directory).condition(frames))
    assert outcome in ("push_green_to_white: success", "push_green_to_white: no success")


def test_the_package_is_cheap_to_import():
    code = (
        "import sys, bgpo_trl; names = dir(bgpo_trl)\n"
        "assert not {'torch', 'numpy', 'mujoco'} & set(sys.modules)\n"
        "assert {'TrainedPolicy', '__version__', 'load_run'} <= set(names)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    with pytest.raises(AttributeError, match="'bgpo_trl' has no attribute 'lode_run'"):
        _ = bgpo_trl.lode_run
