"""A tiny deterministic environment, and the transforms around it."""

from types import SimpleNamespace

import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import Compose, EnvBase, RewardSum, StepCounter, TransformedEnv

from bgpo_trl.modules.gwr import GWRB
from bgpo_trl.modules.sequence_autoencoder import SequenceAutoencoder
from bgpo_trl.modules.vae import VAE
from bgpo_trl.transforms import (
    BehaviorLookup,
    BehaviorMatchingReward,
    DemonstrationSource,
    FrameEncoder,
    TaskSchedule,
)

CONCURRENT = TaskSchedule((0, 0, 0))


class MockEnv(EnvBase):
    """A row's frames show its seed, task, step and last action, and do not depend on other rows.

    Its episodes last `lengths[row]` steps and end with a reward of 1; before, the reward is 0.
    """

    def __init__(self, seeds=None, lengths=4, pixels_key="pixels"):
        rows = torch.tensor(0 if seeds is None else seeds)
        batch_size = rows.shape
        super().__init__(device="cpu", batch_size=batch_size)
        self.pixels_key = pixels_key
        self.seeds = rows
        self.lengths = torch.as_tensor(lengths).expand(batch_size)
        self.steps = torch.zeros(batch_size, dtype=torch.int64)
        self.task = torch.zeros(batch_size, dtype=torch.int64)
        self.task_resets = []
        pixels = Unbounded((*batch_size, 32, 64, 3), dtype=torch.uint8)
        task = Unbounded(batch_size, dtype=torch.int64)
        self.observation_spec = Composite({"task": task}, shape=batch_size)
        self.observation_spec[pixels_key] = pixels
        self.state_spec = Composite({"task": task.clone()}, shape=batch_size)
        self.action_spec = Bounded(-1, 1, (*batch_size, 4), dtype=torch.float32)
        self.reward_spec = Bounded(0, 1, (*batch_size, 1), dtype=torch.float32)

    def _observe(self, action):
        shown = torch.stack([self.seeds, self.task, self.steps], -1) * 40 + action * 30
        pixels = shown.clamp(0, 255).to(torch.uint8)[..., None, None, :]
        ramp = torch.arange(64, dtype=torch.uint8)[:, None]
        data = TensorDict({"task": self.task.clone()}, self.batch_size, device="cpu")
        return data.set(self.pixels_key, pixels.expand(*self.batch_size, 32, 64, 3) + ramp)

    def _reset(self, tensordict, **kwargs):
        rows = torch.ones(self.batch_size, dtype=torch.bool)
        if tensordict is not None:
            rows = tensordict.get("_reset", rows).reshape(self.batch_size)
            self.task = torch.where(rows, tensordict.get("task", self.task), self.task)
            self.task_resets.append(tensordict.get("task", None))
        self.steps = torch.where(rows, 0, self.steps)
        return self._observe(torch.zeros(*self.batch_size, 1))

    def _step(self, tensordict):
        self.steps = self.steps + 1
        done = (self.steps >= self.lengths).unsqueeze(-1)
        data = self._observe(tensordict["action"].mean(-1, keepdim=True))
        return data.update({"reward": done.float(), "terminated": done, "done": done.clone()})

    def _set_seed(self, seed):
        pass


class TopRow(torch.nn.Module):
    """A fast replacement of the VAE, whose latents are the topmost pixels."""

    def __init__(self):
        super().__init__()
        self.n_frames = []

    def latent(self, pixels):
        self.n_frames.append(pixels.shape[:-3].numel())
        return pixels[..., 0, :, 0].float() / 64 - 2


def make_bank(n_tasks=3, n_each=20):
    generator = torch.Generator().manual_seed(7)
    task = torch.arange(n_tasks * n_each) % n_tasks
    embedding = torch.rand(len(task), 32, generator=generator) - 0.5 + task.unsqueeze(-1) * 0.4
    return SimpleNamespace(embedding=embedding, task=task)


def generators(seeds):
    return [torch.Generator().manual_seed(seed) for seed in seeds]


def make_modules(seeds=None):
    """The three learned parts; `seeds` of GWR-B's networks, None for a single one of seed 0."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        vae, lae = VAE(), SequenceAutoencoder()
    batch_size = [] if seeds is None else [len(seeds)]
    gwr = GWRB(32, batch_size=batch_size, generator=generators(seeds or [0]))
    return vae, lae, gwr


def make_source(seeds=None, schedule=CONCURRENT):
    """Demonstrations for an environment; `seeds` None is an unbatched one of seed 0."""
    batch_size = [] if seeds is None else [len(seeds)]
    streams = generators(seeds or [0])
    return DemonstrationSource(make_bank(), schedule, batch_size=batch_size, generator=streams)


def make_env(seeds=None, lengths=4, beta=0.1):
    """The whole composition; for `seeds`, see `make_source`."""
    _, lae, gwr = make_modules(seeds)
    return TransformedEnv(
        MockEnv(seeds, lengths),
        Compose(
            FrameEncoder(TopRow()),
            StepCounter(5),
            make_source(seeds),
            BehaviorLookup(gwr, learn=True),
            BehaviorMatchingReward(lae, beta),
            RewardSum(),
        ),
    )


def play(env, n_steps, data=None):
    """Step with partial resets and a fixed action; return the steps and the data after them."""
    data = env.reset() if data is None else data
    steps = []
    for _ in range(n_steps):
        data["action"] = torch.full((*env.batch_size, 4), 0.5)
        step, data = env.step_and_maybe_reset(data)
        steps.append(step.clone())
    return torch.stack(steps, -1), data
