"""One update: this package, a TorchRL loop, Stable-Baselines3, and a floor in bare torch.

An update samples 128 transitions and makes one gradient step of actor and critic and one step of
their targets. All contenders have networks of 96 inputs, 4 actions and 256 hidden units, without
layer norm, and draw from 50,000 random transitions; those "without sampling" reuse one batch, which
stays in the cache. Only this package and the floor step several seeds together. BGPO's learner has
five critics, two hidden layers, and layer norm in the critics, as in its runs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl import objectives
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.modules import MLP, TanhModule, ValueOperator

from bgpo_trl.algorithms.rl import LearnerSpec, make_learner
from bgpo_trl.configs import SHOWN, BGPOConfig
from bgpo_trl.data.replay import GroupReplay
from bgpo_trl.modules.actor_critic import Actor, Critic
from bgpo_trl.objectives.ddpg import DDPGLoss, ForeachSoftUpdate
from bgpo_trl.seeding import generators

Contender = tuple[Callable[[], object], int]

LATENT, BEHAVIOR, ACTION, HIDDEN, BATCH = 64, 32, 4, 256, 128
LEARNING_RATE, GAMMA, TAU = 1e-3, 0.95, 0.005


def contenders(seeds: int = 10, transitions: int = 50_000) -> dict[str, Contender]:
    """Return the contenders for `timing.interleave`.

    Stable-Baselines3 is skipped, with a line on how to install it, if it is missing. The caller
    sets the number of threads with ``torch.set_num_threads``.

    Args:
        seeds: Number of seeds that this package and the floor step together.
        transitions: Number of transitions in each replay buffer, per seed.

    Returns:
        For each name, a call that takes some milliseconds and the number of updates it makes,
        summed over seeds.
    """
    stack, single = Ours(seeds, transitions), Ours(1, transitions)
    fixed, fixed_single = Ours(seeds, BATCH), Ours(1, BATCH)
    batch, batch_single = fixed.sample(), fixed_single.sample()
    floor = Floor(fixed.loss)
    found: dict[str, Contender] = {
        f"ours, {seeds} seeds": (stack.update, seeds),
        "ours, 1 seed": (_repeat(single.update, 4), 4),
        f"ours, {seeds} seeds, without sampling": (lambda: fixed.learn(batch), seeds),
        "ours, 1 seed, without sampling": (_repeat(lambda: fixed_single.learn(batch_single), 4), 4),
        f"floor, {seeds} seeds, without sampling": (_on_tensors(floor, batch), seeds),
        "TorchRL loop": (_repeat(TorchRLLoop(transitions).update, 4), 4),
        "BGPO's learner, 2 seeds, without sampling": (bgpo_learner(2), 2),
        "its clone alone": (bgpo_learner(2, proposals="clone"), 2),
    }
    try:
        for name in ("DDPG", "TD3"):
            call = stable_baselines3(name, transitions, updates=4)
            found[f"Stable-Baselines3, {name}"] = call, 4
    except ImportError:
        print(
            "Skipping Stable-Baselines3; to include it: pip install -c constraints.txt "
            "-e '.[bench]'"
        )
    return found


def random_transitions(*shape: int, generator: torch.Generator) -> TensorDict:
    """Return random transitions with BGPO's entries, one in ten a success."""

    def normal(size: int) -> Tensor:
        return torch.randn(*shape, size, generator=generator)

    success = torch.rand(*shape, 1, generator=generator) < 0.1
    next_data = {"latent": normal(LATENT), "reward": success.float(), "terminated": success}
    action = torch.rand(*shape, ACTION, generator=generator) * 2 - 1
    root = {"latent": normal(LATENT), "behavior": normal(BEHAVIOR), "action": action}
    return TensorDict({**root, "next": next_data}, shape)


class Ours:
    """The learner of `bgpo_trl.algorithms.bgpo.BGPO`, without an environment.

    Args:
        seeds: Number of seeds in the batch.
        transitions: Number of random transitions in the replay buffer.
        **options: Options of the loss, as in `DDPGLoss`.
    """

    def __init__(self, seeds: int, transitions: int, **options) -> None:
        numbers, size = range(seeds), LATENT + BEHAVIOR
        network = {"hidden_sizes": (HIDDEN,), "batch_size": [seeds]}
        self.loss = DDPGLoss(
            Actor(size, ACTION, generator=generators(numbers, "actor"), **network),
            Critic(size, ACTION, generator=generators(numbers, "critic"), **network),
            **{"constant_keys": ["behavior"], "return_bounds": (0.0, 1.1), **options},
        )
        self.loss.make_value_estimator(gamma=GAMMA)
        self.target_update = ForeachSoftUpdate(self.loss, tau=TAU)
        self.optimizer = torch.optim.Adam(
            list(self.loss.parameters()), lr=LEARNING_RATE, fused=True
        )
        generator = torch.Generator().manual_seed(0)
        stored = random_transitions(transitions, seeds, generator=generator)
        keys = [key for key in stored.keys(True, True) if isinstance(key, str | tuple)]
        self.replay = GroupReplay(transitions, generator=generators(numbers, "replay"), keys=keys)
        self._group = torch.zeros(seeds, dtype=torch.int64)
        for transition in stored:
            self.replay.add(transition, self._group)

    def update(self) -> None:
        """Make one update of every seed."""
        self.learn(self.sample())

    def sample(self) -> TensorDict:
        """Draw a batch ``[S, B]``."""
        return self.replay.sample(self._group.unsqueeze(-1).expand(-1, BATCH))

    def learn(self, batch: TensorDict) -> None:
        """Make one update of every seed from a batch ``[S, B]``."""
        losses = self.loss(batch)
        self.optimizer.zero_grad()
        (losses["loss_actor"] + losses["loss_value"]).backward()
        self.optimizer.step()
        self.target_update.step()


def bgpo_learner(seeds: int, **changes: Any) -> Callable[[], object]:
    """Return an update of BGPO's learner, with its default networks, on a constant batch."""
    spec = LearnerSpec(
        range(seeds), ["latent", "behavior"], LATENT + BEHAVIOR, (0.0, 1.1), torch.device("cpu")
    )
    learner = make_learner(replace(SHOWN, **changes), spec)
    shape = (seeds, 1, BGPOConfig().expert_batch_size)
    batch = random_transitions(*shape, generator=torch.Generator().manual_seed(0))
    batch["imitation"] = batch.select("latent", "behavior", "action")
    return lambda: learner.learn(batch)


class Floor:
    """Lower bound: DDPG of stacked seeds in bare torch, without TensorDicts.

    The arithmetic is that of `DDPGLoss` without clipped targets, penalty and diagnostics.

    Args:
        loss: Source of the initial weights.
    """

    def __init__(self, loss: DDPGLoss) -> None:
        def copy(params) -> list[Tensor]:
            return [tensor.detach().clone() for tensor in params.values(True, True)]

        # Order of each list: weight and bias of the first layer, then of the second.
        self.actor = [nn.Parameter(t) for t in copy(loss.actor_network_params)]
        self.critic = [nn.Parameter(t) for t in copy(loss.value_network_params)]
        self.target_actor = copy(loss.target_actor_network_params)
        self.target_critic = copy(loss.target_value_network_params)
        self.optimizer = torch.optim.Adam([*self.actor, *self.critic], lr=LEARNING_RATE, fused=True)

    def learn(
        self, state: Tensor, action: Tensor, next_state: Tensor, reward: Tensor, goes_on: Tensor
    ) -> None:
        """Make one update of every seed.

        Args:
            state: Latent and behavior, ``[S, B, 96]``.
            action: Actions ``[S, B, 4]``.
            next_state: Next latent and behavior, ``[S, B, 96]``.
            reward: Rewards ``[S, B, 1]``.
            goes_on: 0 for terminal transitions, else 1, ``[S, B, 1]``.
        """
        with torch.no_grad():
            next_action = _mlp(self.target_actor, next_state).tanh()
            next_value = _mlp(self.target_critic, torch.cat([next_state, next_action], -1))
            target = reward + GAMMA * goes_on * next_value
        value = _mlp(self.critic, torch.cat([state, action], -1))
        loss_value = (value - target).square().mean((1, 2)).sum()
        frozen = [tensor.detach() for tensor in self.critic]
        policy_action = _mlp(self.actor, state).tanh()
        loss_actor = -_mlp(frozen, torch.cat([state, policy_action], -1)).mean((1, 2)).sum()
        self.optimizer.zero_grad()
        (loss_actor + loss_value).backward()
        self.optimizer.step()
        with torch.no_grad():
            torch._foreach_lerp_(
                self.target_actor + self.target_critic, self.actor + self.critic, TAU
            )


def _mlp(weights: list[Tensor], x: Tensor) -> Tensor:
    w1, b1, w2, b2 = weights
    hidden = torch.baddbmm(b1.unsqueeze(1), x, w1).relu()
    return torch.baddbmm(b2.unsqueeze(1), hidden, w2)


def floor_batch(batch: TensorDict) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return a batch of `Ours` as the arguments of `Floor.learn`."""
    successor = batch["next"]
    return (
        torch.cat([batch["latent"], batch["behavior"]], -1),
        batch["action"].contiguous(),
        torch.cat([successor["latent"], batch["behavior"]], -1),
        successor["reward"].contiguous(),
        1 - successor["terminated"].float(),
    )


class TorchRLLoop:
    """DDPG as in TorchRL's own example (sota-implementations/ddpg), with the same network sizes.

    Args:
        transitions: Number of random transitions in the replay buffer.
    """

    def __init__(self, transitions: int) -> None:
        size = LATENT + BEHAVIOR
        network = {"num_cells": [HIDDEN], "activation_class": nn.ReLU}
        policy = MLP(in_features=size, out_features=ACTION, **network)
        actor = TensorDictSequential(
            TensorDictModule(policy, in_keys=["observation"], out_keys=["param"]),
            TanhModule(in_keys=["param"], out_keys=["action"]),
        )
        critic = ValueOperator(
            MLP(in_features=size + ACTION, out_features=1, **network),
            in_keys=["action", "observation"],
        )
        self.loss = objectives.DDPGLoss(
            actor, critic, loss_function="l2", delay_actor=True, delay_value=True
        )
        self.loss.make_value_estimator(gamma=GAMMA)
        self.target_update = objectives.SoftUpdate(self.loss, tau=TAU)
        self.actor_optimizer, self.critic_optimizer = (
            torch.optim.Adam(list(params.flatten_keys().values()), lr=LEARNING_RATE)
            for params in (self.loss.actor_network_params, self.loss.value_network_params)
        )
        self.replay = TensorDictReplayBuffer(
            storage=LazyTensorStorage(transitions), batch_size=BATCH
        )
        data = random_transitions(transitions, generator=torch.Generator().manual_seed(0))
        successor = data["next"]
        successor["done"] = successor["terminated"]
        for part in (data, successor):
            part["observation"] = torch.cat([part.pop("latent"), data["behavior"]], -1)
        self.replay.extend(data.exclude("behavior"))

    def update(self) -> None:
        """Make one update."""
        batch = self.replay.sample()
        loss_value, _ = self.loss.loss_value(batch)
        loss_value.backward()
        self.critic_optimizer.step()
        self.critic_optimizer.zero_grad()
        loss_actor, _ = self.loss.loss_actor(batch)
        loss_actor.backward()
        self.actor_optimizer.step()
        self.actor_optimizer.zero_grad()
        self.target_update.step()


def stable_baselines3(name: str, transitions: int, updates: int) -> Callable[[], object]:
    """Return a call that makes updates with an algorithm of Stable-Baselines3.

    Args:
        name: ``"DDPG"`` or ``"TD3"``.
        transitions: Number of random transitions in the replay buffer.
        updates: Updates per call.

    Raises:
        ImportError: If Stable-Baselines3 is not installed.
    """
    import gymnasium
    import stable_baselines3 as sb3
    from stable_baselines3.common.logger import Logger

    class Nowhere(gymnasium.Env):
        """Observation and action spaces only; never stepped."""

        observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (LATENT + BEHAVIOR,))
        action_space = gymnasium.spaces.Box(-1.0, 1.0, (ACTION,))

    model = getattr(sb3, name)(
        "MlpPolicy",
        Nowhere(),
        policy_kwargs={"net_arch": [HIDDEN]},
        learning_rate=LEARNING_RATE,
        batch_size=BATCH,
        buffer_size=transitions,
        gamma=GAMMA,
        tau=TAU,
        device="cpu",
    )
    model.set_logger(Logger(None, []))
    rng, replay = np.random.default_rng(0), model.replay_buffer
    for array in (replay.observations, replay.next_observations):
        rng.standard_normal(out=array, dtype=np.float32)
    replay.actions[:] = rng.uniform(-1, 1, replay.actions.shape)
    replay.dones[:] = replay.rewards[:] = rng.random(replay.dones.shape) < 0.1
    replay.full = True
    return lambda: model.train(gradient_steps=updates, batch_size=BATCH)


def _repeat(call: Callable[[], object], times: int) -> Callable[[], object]:
    def repeated() -> None:
        for _ in range(times):
            call()

    return repeated


def _on_tensors(floor: Floor, batch: TensorDict) -> Callable[[], object]:
    tensors = floor_batch(batch)
    return lambda: floor.learn(*tensors)
