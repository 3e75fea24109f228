"""Settings of all tests, and parts of a run that take about a second."""

import gc
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from json import JSONDecodeError
from pathlib import Path
from typing import Any

import mujoco
import pytest
import torch
from hypothesis import settings

from bgpo_trl.algorithms import ALGORITHMS, entry
from bgpo_trl.configs import BGPOConfig, RepresentationConfig, RunConfig
from bgpo_trl.configs.runs import PAPER_TASKS
from bgpo_trl.data.bank import DemonstrationBank, DemonstrationSteps
from bgpo_trl.encoders.representation import Representation
from bgpo_trl.figures import style
from bgpo_trl.modules.frame_network import FRAME_NETWORKS
from bgpo_trl.modules.inverse_model import InverseModel
from bgpo_trl.modules.sequence_autoencoder import SequenceAutoencoder
from bgpo_trl.modules.vae import VAE
from bgpo_trl.scenes import SCENES, Outcome
from bgpo_trl.scenes.nico import NICO, NicoEnv, NicoSimulation
from bgpo_trl.training import Trainer
from bgpo_trl.world import World
from suites.nico import nico
from tests.helpers import contents

# Without a deadline, since the duration of an example depends on the load of the machine.
settings.register_profile("bgpo_trl", deadline=None)
settings.load_profile("bgpo_trl")
torch.set_num_threads(1)

# Further settings of small runs.
SMALL = {
    "maml": {"task_batch_size": 8, "adaptation_size": 12},
    "dist-nll": {"task_batch_size": 8, "samples": 24, "distillation_batch_size": 12},
    "ewc": {"fisher_samples": 10},
}


def pytest_collection_finish():
    """Exclude imported modules from garbage collection, which would slow down the tests."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000)


def of_name(settings, name):
    """Return the settings of an algorithm, also of those named after it, such as ``maml-paper``."""
    return next((s for start, s in settings.items() if name.startswith(start)), {})


@pytest.fixture(scope="session")
def encoders():
    """Untrained encoders."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        vae, lae = VAE(), SequenceAutoencoder()
        inverse = InverseModel()
    for module in (vae, lae, inverse):
        module.eval().requires_grad_(False)
    metadata = {
        "scene": NICO.identity,
        "spread": "1.0",
        "config": json.dumps(asdict(RepresentationConfig())),
        "seed": "0",
        "command": "",
    }
    return Representation(vae, lae, inverse, metadata)


@pytest.fixture(scope="session")
def bank():
    """Three tasks, eight seen and four held-out demonstrations of each, all of them different."""
    generator = torch.Generator().manual_seed(1)
    task = torch.arange(36) % 3
    embedding = torch.rand(36, 32, generator=generator) - 0.5 + 0.8 * task.unsqueeze(-1)
    latent = torch.randn(36, 6, 64, generator=generator)
    action = torch.rand(36, 5, 4, generator=generator) * 2 - 1
    train = torch.arange(36) < 24
    steps = DemonstrationSteps.of(latent, action, (3 + torch.arange(36) % 4) * train)
    return DemonstrationBank(embedding, task, train, PAPER_TASKS, steps=steps)


@pytest.fixture(scope="session")
def make_config():
    """Make the settings of a run of two seeds and 10 episodes, with some of them changed.

    Those of its algorithm and of this one's networks and updates are changed by name.
    """

    def make(state="latent", name="bgpo", *, rl=None, algorithm=None, **changes):
        small = {"hidden_sizes": (64,), "batch_size": 16, "warmup_steps": 8, "replay_size": 200}
        small |= {"clone_episodes": 2}
        # Demonstrations are latents; without noise, a test can identify them among other data.
        share = 0.25 if entry(name).config.demonstration_share and state == "latent" else 0.0
        if not share:
            small["proposals"] = "actor"
        rl = replace(entry(name).config.rl, **{**small, **(rl or {})})
        settings = {"state": state, "max_steps": 6, "rl": rl, **of_name(SMALL, name)}
        if isinstance(entry(name).config, BGPOConfig):
            settings |= {"expert_batch_size": 8, "group_size": 4}
        settings |= {"demonstration_share": share, **(algorithm or {})}
        settings["demonstration_noise"] = 0.0 if settings["demonstration_share"] else None
        algorithm = replace(entry(name).config, **settings)
        config = RunConfig(
            seeds=(3, 8),
            episodes=10,
            task_starts=(0, 2, 4),
            eval_every=2,
            name=name,
            algorithm=algorithm,
        )
        return replace(config, **changes)

    return make


@pytest.fixture
def in_world():
    """Give an algorithm a `World`, its attribute ``world``."""

    def enter(algorithm, schedule):
        algorithm.world = World(algorithm, schedule=schedule)
        return algorithm

    return enter


@pytest.fixture(scope="session")
def begin(bank, encoders, make_config):
    """Make the trainer of a run, by default of the settings of `make_config`."""

    def make(directory, config=None, **arguments):
        parts = {"bank": bank, "encoders": encoders, "progress": False, **arguments}
        return Trainer(config or make_config(), directory, **parts)

    return make


class EasySimulation(NicoSimulation):
    """A simulation whose episodes also end, with success, once the arm is turned to one side.

    Nothing collides or falls: a contact would make the rounding of a batch, which differs from that
    of a seed alone, a hundred thousand times larger within two steps.
    """

    def __init__(self, tasks, **options):
        super().__init__(tasks, **options)
        disabled = mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_GRAVITY
        self.environment.physics.model.opt.disableflags |= disabled

    def step(self, action):
        success = super().step(action).success
        return Outcome(success or self.environment.physics.arm_angles()[0] > 0.1)


class EasyNicoEnv(NicoEnv):
    def _simulation(self):
        return EasySimulation(self.tasks, spread=self._spread)


EASY = replace(NICO, make_env=EasyNicoEnv)
"""A scene in which episodes end after 1 to 6 steps, so that seeds are soon out of step."""


@pytest.fixture(scope="module")
def easy_world():
    """A world in which episodes end after 1 to 6 steps, so that seeds are soon out of step.

    It lasts for the module: mark all of it with `pytest.mark.usefixtures("easy_world")`.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(SCENES, "nico", EASY)
        yield EasyNicoEnv


@pytest.fixture(autouse=True)
def restored_registries() -> Iterator[None]:
    """Remove tasks, scenes, algorithms and frame networks that a test has added."""
    registries: list[dict[str, Any]] = [nico._TASKS, ALGORITHMS, SCENES, FRAME_NETWORKS]
    before = [dict(registry) for registry in registries]
    yield
    for registry, entries in zip(registries, before, strict=True):
        registry.clear()
        registry.update(entries)


@pytest.fixture(scope="session", autouse=True)
def few_pixels() -> Iterator[None]:
    """Save figures with fewer pixels, which is faster."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(style, "DPI", 60)
        yield


@pytest.fixture(scope="session", autouse=True)
def interruptible() -> Iterator[None]:
    """Handle Ctrl-C as at a terminal, since a background job ignores it.

    Processes that fixtures start, such as Ray, inherit this.
    """
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def refused(tmp_path) -> Callable[..., None]:
    """Check that a call raises one line with cause and remedy, and changes no file."""

    def check(call: Callable[[], object], cause: str, remedy: str) -> None:
        before = contents(tmp_path)
        with pytest.raises((ValueError, OSError, RuntimeError)) as raised:
            call()
        message = str(raised.value)
        assert not isinstance(raised.value, JSONDecodeError | UnicodeDecodeError)
        assert message.isprintable()  # one line, and nothing that a terminal would act on
        assert cause in message
        assert remedy in message
        assert contents(tmp_path) == before

    return check


_OTHER_PROCESS = """
import sys
from bgpo_trl.files.writing import lock_directory

directory, wait = sys.argv[1], sys.argv[2] == "True"
if wait:
    print("waits", flush=True)
with lock_directory(directory, wait=wait):
    print("has it", flush=True)
    input()
"""


@pytest.fixture
def other_process() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Start processes that hold a directory until they read a line.

    They print ``has it``, before it ``waits`` if they may wait; or they are refused.
    """
    started: list[subprocess.Popen[str]] = []

    def start(directory: Path, *, wait: bool = False) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-c", _OTHER_PROCESS, str(directory), str(wait)],
            env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()
