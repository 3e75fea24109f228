"""BGPO with one policy (Alg. 1) in one file: python examples/bgpo_minimal.py --episodes 200.

Actor, critic, replay, DDPG and the training loop in plain PyTorch, for one seed; transforms of this
package encode the frames, draw the demonstrations, infer the behavior and add the intrinsic reward.
It computes what ``--algorithm bgpo-single`` computes: `tests/test_bgpo_minimal.py` compares the two
step by step. Minutes are enough to see it run, not to see it learn: the paper trains for 20,000
episodes.

Algorithm, equations and sections are those of Hafez & Wermter (2021). What they do not have is
marked "ours"; `docs/deviations.md` gives the reasons.
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
import tyro
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.envs import ClipTransform, Compose, StepCounter, TransformedEnv

from bgpo_trl.configs import GWRBConfig
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.encoders.pretrained import load_pretrained
from bgpo_trl.encoders.representation import Representation
from bgpo_trl.evaluation import start_seeds
from bgpo_trl.modules.gwr import GWRB
from bgpo_trl.scenes.nico import NicoEnv
from bgpo_trl.seeding import generators, stream_seed
from bgpo_trl.transforms import (
    BehaviorLookup,
    BehaviorMatchingReward,
    DemonstrationSource,
    FrameEncoder,
    TaskSchedule,
)

ACTION_SIZE = 4  # three joints of the arm, one of the hand (Sec. IV)


@dataclass(frozen=True)
class Settings:
    """Settings of a run; those of the algorithm are the defaults of ``bgpo-single``."""

    seed: int = 0  # seed of the run
    episodes: int = 200  # training episodes E (20,000 in Figs. 6 and 8)
    # Episode from which each task is presented: those of Sec. IV-C, a hundred times as early; all 0
    # is the concurrent setting of Sec. IV-B.
    task_starts: tuple[int, ...] = (0, 70, 130)
    test_every: int = 20  # training episodes between tests
    test_episodes: int = 5  # episodes of each task in a test
    max_steps: int = 50  # steps of an episode (Sec. IV-B)
    beta: float = 0.1  # weight of the intrinsic reward (Sec. IV-A)
    behavior_scale: float = 0.25  # factor of b in the input of actor and critic; ours
    state_limit: float = 5.0  # bound of the latents that actor and critic read; ours
    # Factor of distances in the activity (Eq. 2); ours. GWR-B's other defaults are Table 1.
    activity_scale: float = 0.25
    hidden_sizes: tuple[int, ...] = (256, 256)  # ours (Sec. IV-A: one layer of 64 units)
    learning_rate: float = 1e-3  # of Adam (Sec. IV-A)
    batch_size: int = 128  # transitions of an update; ours (256 in Sec. IV-A)
    replay_size: int = 1_000_000  # capacity of the replay buffer (Sec. IV-A)
    warmup_steps: int = 256  # steps before the first update; ours
    noise: float = 0.3  # standard deviation of the exploration noise; ours
    gamma: float = 0.95  # discount factor; ours
    tau: float = 0.005  # rate of the target networks' soft update; ours
    pre_tanh_penalty: float = 0.01  # weight of the squared actions before the tanh; ours


class Replay:
    """The buffer B of Alg. 1: a ring of transitions (z, b, a, r, z'), sampled uniformly."""

    def __init__(self, capacity: int, generator: torch.Generator) -> None:
        self.capacity, self.generator, self.n_added = capacity, generator, 0
        self.rows: dict[str, Tensor] = {}

    def add(self, **transition: Tensor) -> None:
        """Store a transition ``[features]``; overwrite the oldest if the buffer is full."""
        if not self.rows:
            self.rows = {
                key: torch.empty(self.capacity, *value.shape, dtype=value.dtype)
                for key, value in transition.items()
            }
        for key, value in transition.items():
            self.rows[key][self.n_added % self.capacity] = value
        self.n_added += 1

    def sample(self, n: int) -> dict[str, Tensor]:
        """Draw transitions ``[n, features]`` with replacement."""
        size = min(self.n_added, self.capacity)
        drawn = (torch.rand(n, generator=self.generator, dtype=torch.float64) * size).long()
        row = (self.n_added - size + drawn) % self.capacity
        return {key: values[row] for key, values in self.rows.items()}


def perceptron(sizes: tuple[int, ...], stream: torch.Generator, layer_norm: bool) -> nn.Sequential:
    """Return a perceptron with PyTorch's usual initial weights, drawn from a stream of its own."""
    layers: list[nn.Module] = []
    for n_in, n_out in pairwise(sizes):
        layer, bound = nn.Linear(n_in, n_out), n_in**-0.5
        weight = torch.empty(n_in, n_out).uniform_(-bound, bound, generator=stream)
        with torch.no_grad():
            layer.weight.copy_(weight.T)
            layer.bias.uniform_(-bound, bound, generator=stream)
        norm = [nn.LayerNorm(n_out, elementwise_affine=False)] if layer_norm else []
        layers += [layer, *norm, nn.ReLU()]
    return nn.Sequential(*layers[: -1 - layer_norm])  # the output is linear


class MinimalBGPO:
    """One seed of Behavior-Guided Policy Optimization with DDPG as f_RL (Alg. 1).

    Args:
        settings: Settings of the run.
        encoders: Frozen encoders f_V (``frame_network``) and f_L (``lae``).
        bank: Demonstrations, already embedded by them: phi_d (Alg. 1, line 7).
    """

    def __init__(
        self, settings: Settings, encoders: Representation, bank: DemonstrationBank
    ) -> None:
        self.settings, self.tasks = settings, bank.tasks
        # One stream of random numbers for each purpose, named as in the library ("actor 0" is its
        # actor of expert 0), so that both draw the same numbers.
        stream = {
            name: generators([settings.seed], name)[0]
            for name in ("actor 0", "critic 0", "gwr", "demonstrations", "exploration", "replay")
        }
        self.exploration = stream["exploration"]
        self.replay = Replay(settings.replay_size, stream["replay"])
        self.gwr = GWRB(
            bank.embedding.shape[-1],
            GWRBConfig(activity_scale=settings.activity_scale),
            generator=stream["gwr"],
        )

        n_inputs = encoders.frame_network.latent_size + self.gwr.n_features
        hidden = settings.hidden_sizes
        actor_sizes = (n_inputs, *hidden, ACTION_SIZE)
        critic_sizes = (n_inputs + ACTION_SIZE, *hidden, 1)
        self.actor = perceptron(actor_sizes, stream["actor 0"], layer_norm=False)
        # Layer norm is ours: it halves the episodes needed.
        self.critic = perceptron(critic_sizes, stream["critic 0"], layer_norm=True)
        self.target_actor, self.target_critic = deepcopy(self.actor), deepcopy(self.critic)
        self.actor_optimizer = torch.optim.Adam(self.actor.parameters(), settings.learning_rate)
        self.critic_optimizer = torch.optim.Adam(self.critic.parameters(), settings.learning_rate)

        # A success ends the episode with 1 + beta r_int <= 1 + beta. A time-out pays beta r_int
        # and bootstraps, since the time limit is not part of the task.
        success = 1.0 + settings.beta
        self.highest_return = max(success, settings.beta + settings.gamma * success)

        encode = FrameEncoder(encoders.frame_network, del_keys=True)  # pixels -> latent (line 13)
        clip = ClipTransform(["latent"], low=-settings.state_limit, high=settings.state_limit)
        schedule = TaskSchedule(settings.task_starts)
        self.env = TransformedEnv(
            NicoEnv(bank.tasks, seed=stream_seed(settings.seed, "env")),
            Compose(
                [
                    encode,
                    StepCounter(settings.max_steps),
                    # Draws a task, then one of its demonstrations: demo_embedding, phi_d (line 6).
                    DemonstrationSource(bank.seen(), schedule, generator=stream["demonstrations"]),
                    # b = w_c (lines 8 and 9). GWR-B learns from phi_d (Eqs. 2-6, line 10) when the
                    # episode ends, with the same result, since nothing looks b up in between.
                    BehaviorLookup(self.gwr, learn=True),
                    # At the end of an episode, r = r_ext + beta exp(-||b - phi_g||) (Eq. 7, lines
                    # 18-22). Before clipping, since demonstrations are embedded without it.
                    BehaviorMatchingReward(encoders.lae, settings.beta),
                    clip,
                ]
            ),
        )
        self.held_out = bank.held_out("validation")
        self.test_shape = (len(self.tasks), settings.test_episodes)
        self.simulations = NicoEnv(bank.tasks, batch_size=self.test_shape)
        self.test_env = TransformedEnv(self.simulations, Compose([encode.clone(), clip.clone()]))

    def train(self) -> None:
        """Train for all episodes; print the success in training and in tests."""
        settings, successes = self.settings, list[float]()
        state = self.env.reset()  # lines 6-11
        while len(successes) < settings.episodes:
            state["action"] = self.explore(state)
            # From earlier steps only: the library updates while the environment steps.
            if self.replay.n_added >= settings.warmup_steps:
                self.update()
            transition, state = self.env.step_and_maybe_reset(state)  # lines 16-21
            self.store(transition)
            if transition["next", "done"]:
                successes.append(float(transition["next", "terminated"]))
                if len(successes) % settings.test_every == 0:
                    recent = np.mean(successes[-settings.test_every :])
                    rates = self.test(len(successes) // settings.test_every - 1)
                    print(f"episode {len(successes)}: {int(self.gwr.num_nodes)} nodes", end=", ")
                    print(f"success in training {recent:.2f}, in tests {rates}", flush=True)

    def inputs(self, latent: Tensor, behavior: Tensor) -> Tensor:
        """Return the input of actor and critic, z and b in place of the state (Eq. 8)."""
        return torch.cat([latent, self.settings.behavior_scale * behavior], -1)

    @torch.no_grad()
    def explore(self, state: TensorDictBase) -> Tensor:
        """Return an action ``[4]`` of the policy with Gaussian noise (line 15)."""
        action = self.actor(self.inputs(state["latent"], state["behavior"])).tanh()
        noise = self.settings.noise * torch.randn(ACTION_SIZE, generator=self.exploration)
        return (action + noise).clamp(-1.0, 1.0)

    def store(self, transition: TensorDictBase) -> None:
        """Store (z, b, a, r, z') in B (lines 22 and 24), and whether z' is a success."""
        self.replay.add(
            latent=transition["latent"],
            behavior=transition["behavior"],
            action=transition["action"],
            reward=transition["next", "reward"].squeeze(-1),
            next_latent=transition["next", "latent"],
            terminated=transition["next", "terminated"].squeeze(-1),
        )

    def update(self) -> tuple[Tensor, Tensor]:
        """Update actor and critic by DDPG (line 26); return their losses ``[]``."""
        settings = self.settings
        batch = self.replay.sample(settings.batch_size)
        inputs = self.inputs(batch["latent"], batch["behavior"])
        next_inputs = self.inputs(batch["next_latent"], batch["behavior"])

        # The critic's target r + gamma Q'(s', pi'(s')) (Lillicrap et al., 2016), clipped to the
        # returns that can be attained. Clipping is ours: without it, Q grows to hundreds.
        with torch.no_grad():
            next_action = self.target_actor(next_inputs).tanh()
            next_value = self.target_critic(torch.cat([next_inputs, next_action], -1)).squeeze(-1)
            target = batch["reward"] + settings.gamma * ~batch["terminated"] * next_value
            target = target.clamp(0.0, self.highest_return)
        value = self.critic(torch.cat([inputs, batch["action"]], -1)).squeeze(-1)
        critic_loss = (value - target).square().mean()

        # The actor ascends Q(s, pi(s)) (Eq. 8). The penalty is ours: without it, tanh saturates.
        pre_tanh = self.actor(inputs)
        policy_value = self.critic(torch.cat([inputs, pre_tanh.tanh()], -1)).squeeze(-1)
        penalty = settings.pre_tanh_penalty * pre_tanh.square().mean()
        actor_loss = penalty - policy_value.mean()

        self.actor_optimizer.zero_grad()
        actor_loss.backward()
        self.critic_optimizer.zero_grad()  # of the gradients that the actor's loss left in it
        critic_loss.backward()
        self.actor_optimizer.step()
        self.critic_optimizer.step()

        online = [*self.actor.parameters(), *self.critic.parameters()]
        targets = [*self.target_actor.parameters(), *self.target_critic.parameters()]
        with torch.no_grad():
            for target_weight, weight in zip(targets, online, strict=True):
                target_weight.lerp_(weight, settings.tau)
        return actor_loss.detach(), critic_loss.detach()

    @torch.no_grad()
    def test(self, number: int) -> dict[str, float]:
        """Return the success rate of each task, without noise, for held-out demonstrations.

        Nothing learns from tests. Starts and demonstrations depend on seed and ``number`` alone.
        """
        seed, (n_tasks, n_episodes) = self.settings.seed, self.test_shape
        rng = np.random.default_rng([stream_seed(seed, "evaluation"), number])
        of_task = [np.flatnonzero(self.held_out.task == task) for task in range(n_tasks)]
        drawn = np.stack([rows[rng.integers(len(rows), size=n_episodes)] for rows in of_task])
        behavior = self.gwr.lookup(self.held_out.embedding[torch.from_numpy(drawn)]).embedding

        self.simulations.seed_rows(start_seeds(seed, number, self.test_shape).ravel().tolist())
        task = torch.arange(n_tasks).repeat_interleave(n_episodes).view(self.test_shape)
        state = self.test_env.reset(TensorDict({"task": task}, self.test_shape))
        for _ in range(self.settings.max_steps):
            state["action"] = self.actor(self.inputs(state["latent"], behavior)).tanh()
            state = self.test_env.step(state)["next"]  # episodes that have ended stand still
        rates = state["terminated"].float().mean((1, 2))
        return {task: round(float(rate), 2) for task, rate in zip(self.tasks, rates, strict=True)}


if __name__ == "__main__":
    settings = tyro.cli(Settings, description=__doc__)
    MinimalBGPO(settings, *load_pretrained()).train()
