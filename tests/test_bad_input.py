"""Wrong values and files in Python: each is refused in one line that says what to do.

A case is a call and what its message says of the cause, for files also of the remedy. Settings are
in `test_configs.py`, command lines in `experiments/test_command_line.py`. Values of a wrong Python
type are not here: the types are annotated, and their errors are Python's own.
"""

import math
from functools import partial
from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.envs import Compose, StepCounter, TransformedEnv

from bgpo_trl.configs import VAEConfig
from bgpo_trl.data.recording import record_demonstrations
from bgpo_trl.encoders.pretrained import bank_path, default_weights, load_pretrained
from bgpo_trl.encoders.representation import load_representation
from bgpo_trl.files.checkpoint import load_checkpoint, save_checkpoint
from bgpo_trl.files.csv_file import CsvFile
from bgpo_trl.modules.actor_critic import Actor, Critic, ProposalPolicy
from bgpo_trl.modules.gwr import GWRB
from bgpo_trl.modules.multi_head_actor import MultiHeadActor
from bgpo_trl.modules.sequence_autoencoder import SequenceAutoencoder
from bgpo_trl.modules.vae import VAE
from bgpo_trl.objectives.ddpg import DDPGLoss, ForeachSoftUpdate
from bgpo_trl.objectives.supervised import (
    distillation_loss,
    sequence_reconstruction_loss,
    vae_inverse_loss,
)
from bgpo_trl.runs.results import read_json, read_run
from bgpo_trl.scenes.nico import NicoEnv
from bgpo_trl.transforms import (
    BehaviorLookup,
    BehaviorMatchingReward,
    DemonstrationSource,
    FrameEncoder,
    TaskSchedule,
)
from suites import nico
from suites.nico.demonstrator import Demonstrator

NAN = math.nan


def bank(n=6, tasks=3, value=0.1):
    return SimpleNamespace(embedding=torch.full((n, 32), value), task=torch.arange(n) % tasks)


def world(*transforms, observation="state", **options):
    env = NicoEnv(observation=observation, seed=0, **options)
    return TransformedEnv(env, Compose(StepCounter(50), *transforms))


def source(**options):
    return DemonstrationSource(bank(), TaskSchedule(), **options)


def step_with(action):
    env = NicoEnv(observation="state", seed=0)
    state = env.reset()
    return env.step(state if action is None else state.set("action", action))


def transitions(without=None, reward=(8, 1)):
    """A batch for `loss`, without one of its entries."""
    flags = {key: torch.zeros(8, 1, dtype=torch.bool) for key in ("done", "terminated")}
    following = {"state": torch.zeros(8, 6), "reward": torch.zeros(reward), **flags}
    batch = {"state": torch.zeros(8, 6), "action": torch.zeros(8, 4), "next": following}
    batch = TensorDict(batch, [8])
    return batch if without is None else batch.exclude(without)


def actor(**options):
    return Actor(6, 4, in_keys=["state"], **options)


def critic(*stack):
    return Critic(6, 4, in_keys=["state"], batch_size=stack)


def loss(**options):
    return DDPGLoss(actor(), critic(), **options)


def windows(*shape, action=4):
    pixels = torch.zeros(*shape, 32, 64, 3, dtype=torch.uint8)
    return TensorDict({"pixels": pixels, "action": torch.zeros(*shape, action)}, shape)


row, z = partial(TensorDict, batch_size=[]), torch.zeros(2, 5, 64)
lae, lengths = SequenceAutoencoder(), torch.tensor([5, 5])
WRONG = {
    # GWR-B
    "gwr of no features": (lambda: GWRB(0), "n_features"),
    "gwr of another start": (lambda: GWRB(4, init="zeros"), "init must be"),
    "gwr of one node": (lambda: GWRB(4, max_nodes=1), "max_nodes must be"),
    "gwr of no network": (lambda: GWRB(4, batch_size=[0]), "batch_size must be"),
    "gwr of few streams": (
        lambda: GWRB(4, batch_size=[3], generator=[torch.Generator()]), "generator must be"),
    "gwr empty": (lambda: GWRB(2, init="data").lookup(torch.zeros(2)), "empty"),
    "gwr part of a node": (lambda: GWRB(2, max_nodes=2.5), "got 2.5"),
    # networks
    "vae of nothing": (lambda: VAE(0), "latent_size"),
    "vae float frames": (lambda: VAE().latent(torch.zeros(32, 64, 3)), "float32"),
    "vae channels first": (lambda: VAE().latent(torch.zeros(3, 32, 64).byte()), "(3, 32, 64)"),
    "vae short latent": (lambda: VAE().decode(torch.zeros(2, 32)), "got [2, 32]"),
    "vae inverse": (lambda: VAE().inverse(z, z[..., :32]), "got [2, 5, 32]"),
    "lae of nothing": (lambda: SequenceAutoencoder(64, 0), "got 64 and 0"),
    "lae short latents": (lambda: lae.encode(z[..., :9], lengths), "[2, 5, 9]"),
    "lae lengths as floats": (lambda: lae.encode(z, lengths.float()), "float32"),
    "lae empty sequence": (lambda: lae.encode(z, 0 * lengths), "in 1..5"),
    "lae other memory": (
        lambda: lae.step(z[:, 0], torch.zeros(2, 32), torch.zeros(1, 64)), "[2, 32] and [1, 64]"),
    "lae other phi": (lambda: lae.decode(torch.zeros(2, 16), 3), "got [2, 16] and 3"),
    "lae no step": (lambda: lae.decode(torch.zeros(2, 32), 0), "got [2, 32] and 0"),
    "one critic for two proposals": (
        lambda: ProposalPolicy(actor(), actor(), critic(1)), "2 critics, got [1]"),
    "critics of other policies": (
        lambda: ProposalPolicy(actor(batch_size=[3]), actor(batch_size=[3]), critic(5)), "got [5]"),
    "lae other state": (lambda: lae.step(z[:, 0], z[:, 0, :16], z[:, 0, :16]), "[2, 16]"),
    "actor without its state": (
        lambda: actor()(row({"z": torch.zeros(6)})), "Actor found no 'state'"),
    "actor with a short state": (lambda: actor()(row({"state": torch.zeros(5)})), "got [5]"),
    "actor of other seeds": (
        lambda: actor(batch_size=[5])(TensorDict({"state": torch.zeros(3, 6)}, [3])), "got [3, 6]"),
    "heads without a trunk": (lambda: MultiHeadActor(6, hidden_sizes=()), "hidden_sizes is empty"),
    "tasks without heads": (
        lambda: MultiHeadActor(4, in_keys=["x"])(TensorDict({"x": torch.zeros(2, 5, 4)}, [2, 5])),
        "2 tasks for 0 heads"),
    # losses
    "ddpg with other weights": (
        lambda: loss()(transitions().set("priority_weight", torch.ones(8, 1))),
        "'priority_weight' must be one weight"),
    "ddpg without action": (lambda: loss()(transitions("action")), "found no 'action'"),
    "ddpg without reward": (lambda: loss()(transitions(("next", "reward"))), "('next', 'reward')"),
    "ddpg without termination": (
        lambda: loss()(transitions(("next", "terminated"))), "lacks ('next'"),
    "ddpg integer termination": (
        lambda: loss()(transitions().apply(lambda x: x.long() if x.dtype is torch.bool else x)),
        "'terminated') must be bool, got torch.int64"),
    "ddpg without next state": (
        lambda: loss()(transitions(("next", "state"))), "under 'next', found no 'state'"),
    "ddpg flat reward": (lambda: loss()(transitions(reward=(8,))), "got [8]"),
    # A container hides the batch size, and with it the seeds whose losses are summed.
    "ddpg in a container": (
        lambda: DDPGLoss(TensorDictSequential(actor(batch_size=[3])), critic(3)), "batch_size"),
    "critics of other seeds": (
        lambda: DDPGLoss(actor(batch_size=[3]), critic(2)), "value_network must have"),
    "clone of no seed": (
        lambda: DDPGLoss(actor(batch_size=[3]), critic(3), actor()), "clone_network must have"),
    "no range of returns": (lambda: loss(return_bounds=(1.0, 1.0)), "return_bounds"),
    "NaN penalty": (lambda: loss(pre_tanh_penalty=NAN), "pre_tanh_penalty"),
    "constants by another name": (lambda: loss(constant_keys=["lable"]), "constant_keys"),
    # Targets would be wrong where an episode ends within n steps.
    "transitions of MultiStep": (
        lambda: loss()(transitions().set("nonterminal", torch.ones(8, 1).bool())),
        "GroupReplay(n_steps="),
    "targets that never move": (lambda: ForeachSoftUpdate(loss(), tau=0.0), "got 0.0"),
    "distillation without teacher": (
        lambda: distillation_loss(actor(), transitions()), "no 'teacher_action'"),
    "distillation without spread": (
        lambda: distillation_loss(actor(), transitions().set("teacher_action", torch.zeros(8, 4))),
        "from its actor, found no 'loc', 'scale'"),
    "windows of one frame": (
        lambda: vae_inverse_loss(VAE(), windows(2, 1), VAEConfig()), "(2, 1, 32"),
    "windows without actions": (
        lambda: vae_inverse_loss(VAE(), windows(2, 2).exclude("action"), VAEConfig()),
        "no 'action'"),
    "actions of another robot": (
        lambda: vae_inverse_loss(VAE(), windows(2, 2, action=7), VAEConfig()), "got [2, 2, 7]"),
    "sequences without lengths": (
        lambda: sequence_reconstruction_loss(lae, TensorDict({"latent": z}, [2])), "no 'length'"),
    # the world
    "no simulation": (lambda: NicoEnv(batch_size=[0]), "got 0"),
    "unknown task": (lambda: NicoEnv(["juggle"], observation="state"), "'juggle'"),
    "no task": (lambda: NicoEnv([]), "got []"),
    "a name for a list": (lambda: NicoEnv("grasp_glass"), "'grasp_glass'"),
    "a task twice": (lambda: NicoEnv(["grasp_glass"] * 2), "'grasp_glass'"),
    "no row": (lambda: source(batch_size=0), "got 0"),
    "no thread": (lambda: NicoEnv(threads=0), "got 0"),
    "frames that are not drawn": (lambda: NicoEnv(observation="state").frames(), "no frames"),
    "action of another robot": (lambda: step_with(torch.zeros(7)), "got [7]"),
    "no action": (lambda: step_with(None), "NicoEnv found no 'action'"),
    "no time": (lambda: nico.load("grasp_glass", time_limit=NAN), "got nan"),
    "demonstrator of a stranger": (
        lambda: Demonstrator(SimpleNamespace(task=None, physics=None)), "NoneType"),
    # transforms
    "schedule of nothing": (lambda: TaskSchedule(()), "()"),
    "schedule without a start": (lambda: TaskSchedule((5, 9)), "(5, 9)"),
    "schedule in parts": (lambda: TaskSchedule((0, 0.5)), "0.5"),
    "NaN demonstration": (lambda: DemonstrationSource(bank(value=NAN), TaskSchedule()), "NaN"),
    "lookup without a source": (
        lambda: world(BehaviorLookup(GWRB(32), learn=True)).reset(),
        "found no 'demo_embedding': put DemonstrationSource before it"),
    "lookup in another size": (
        lambda: world(source(), BehaviorLookup(GWRB(16), learn=True)).reset(), "got [32]"),
    "lookup of nothing": (
        lambda: BehaviorLookup(GWRB(32), learn=False)(row({"x": torch.zeros(32)})),
        "found no 'demo_embedding'"),
    "learning for other rows": (
        lambda: world(
            source(batch_size=[2]), BehaviorLookup(GWRB(32), learn=True), batch_size=[2]
        ).reset(), "a network for each"),
    "bonus without latents": (
        lambda: world(
            source(), BehaviorLookup(GWRB(32), learn=True), BehaviorMatchingReward(lae)
        ).reset(), "found no 'latent'"),
    "bonus by another encoder": (
        lambda: world(
            FrameEncoder(VAE(16)), source(), BehaviorLookup(GWRB(32), learn=True),
            BehaviorMatchingReward(lae), observation="pixels",
        ).reset(), "have sizes (16, 32)"),
    "NaN bonus": (lambda: BehaviorMatchingReward(lae, beta=NAN), "got nan"),
    "time limit too late": (lambda: world(source(), StepCounter(5)).reset(), "DemonstrationSource"),
}  # fmt: skip


@pytest.mark.parametrize(("call", "cause"), WRONG.values(), ids=WRONG.keys())
def test_a_wrong_value_is_refused_in_one_line(call, cause):
    with pytest.raises((ValueError, RuntimeError)) as raised:
        call()
    assert str(raised.value).isprintable()
    assert cause in str(raised.value)


FILES = {
    "csv that is a folder": (lambda f: CsvFile(f, ["a"]), "Is a directory", "choose another run"),
    "checkpoint in a file": (
        lambda f: save_checkpoint(f / "file", {"a": 1}), "cannot save a checkpoint", "make room"),
    "no run": (lambda f: read_run(f / "nowhere"), "there is no run at", "name another"),
    "no settings": (lambda f: read_json(f / "config.json"), "is missing", "let the run in"),
    "no encoders": (
        lambda f: load_pretrained(f / "a.safetensors"), "no encoder weights", "--train-encoders"),
    "a bank for encoders": (
        lambda f: load_representation(bank_path(default_weights())), "damaged or holds no",
        "--train-encoders"),
    "recording of no task": (
        lambda f: record_demonstrations(f / "d", tasks=[], per_task=2, held_out_per_task=1),
        "tasks", "name at least one"),
}  # fmt: skip


@pytest.mark.parametrize(("call", "cause", "remedy"), FILES.values(), ids=FILES.keys())
def test_a_bad_file_is_refused_and_nothing_changes(tmp_path, refused, call, cause, remedy):
    (tmp_path / "file").write_text("x")
    refused(lambda: call(tmp_path), cause, remedy)


def test_a_policy_that_has_diverged_ends_the_run_in_one_line(begin, make_config, tmp_path):
    trainer = begin(tmp_path / "run", make_config("state", "ddpg"))
    for parameter in trainer.algorithm.learner.loss.parameters():
        parameter.data.fill_(NAN)
    with pytest.raises(ValueError, match="diverged"):
        trainer.run()
    assert load_checkpoint(tmp_path / "run" / "checkpoint")["env_steps"] == 0  # none since
    # The files can be read: headers without a row.
    for name in ("train.csv", "eval.csv"):
        assert (tmp_path / "run" / name).read_bytes().count(b"\n") == 1
