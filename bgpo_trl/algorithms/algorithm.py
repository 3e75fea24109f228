"""The base of all algorithms, and the interface of training and test episodes to them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.envs import (
    ClipTransform,
    Compose,
    ObservationNorm,
    RewardSum,
    StepCounter,
    Transform,
    TransformedEnv,
)

from bgpo_trl.algorithms.rl import Learner
from bgpo_trl.configs import AlgorithmConfig
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.data.demonstration_replay import DemonstrationReplay
from bgpo_trl.data.group_replay import GroupReplay
from bgpo_trl.data.task_replay import TaskReplay
from bgpo_trl.encoders.representation import Representation
from bgpo_trl.envs import NicoEnv
from bgpo_trl.modules.behavior_groups import BehaviorGroups
from bgpo_trl.modules.gwr import GWRB
from bgpo_trl.seeding import generators, stream_seed
from bgpo_trl.transforms import DemonstrationSource, FrameEncoder, TaskSchedule
from suites.nico.base import STATE_SIZE

# Middle and spread of joints (rad), grip and object positions (m) in demonstrations, so that the
# ground truth comes to the policy in the scale that latents have.
_STATE_LOC = (0.3, 0.9, 0.9, 0.45, 0.36, 0, 0.68, 0.4, 0.12, 0.655, 0.45, -0.05, 0.645)
_STATE_LOC += (0.41, -0.21, 0.645)
_STATE_SCALE = (0.35, 0.25, 0.35, 0.3, 0.06, 0.15, 0.05, *(0.03, 0.05, 0.02) * 3)


def observe(config: AlgorithmConfig, encoders: Representation | None) -> Transform:
    """Returns the transform from what the simulation shows to the state.

    Args:
        config: Says whether that is latents or the ground truth.
        encoders: The trained encoders; needed for latents.

    Raises:
        ValueError: If latents are asked for without encoders.
    """
    if config.state == "latent":
        if encoders is None:
            raise ValueError("state='latent' needs trained encoders")
        return FrameEncoder(encoders.vae, del_keys=True)
    loc, scale = torch.tensor(_STATE_LOC), torch.tensor(_STATE_SCALE)
    return ObservationNorm(loc, scale, in_keys=["state"], standard_normal=True)


def clip(config: AlgorithmConfig) -> Transform:
    """Returns the transform that bounds what policies read of the state.

    An object knocked off the table is dozens of deviations away and would swamp the rest. It comes
    behind whatever else reads the state: trajectories are embedded as demonstrations are.
    """
    return ClipTransform(in_keys=[config.state], low=-5.0, high=5.0)


class Algorithm(ABC):
    """A learner of several tasks, for a batch of seeds that share nothing but the encoders.

    This class holds the world: simulations, draws of tasks and demonstrations, exploration noise;
    and the gradient step. What is learned from what is each algorithm's own.

    A step of training is ``act``, the environment's step, ``store``; an ``update`` may run while
    the environment takes its step. For test episodes `freeze` copies what the policy of one seed
    depends on, and `act_frozen` acts by such copies.

    Args:
        config: Hyperparameters.
        seeds: One for each element of the batch.
        schedule: Which tasks are presented when.
        bank: Embedded demonstrations for training episodes.
        encoders: The trained encoders; None where they are not used. The frame encoder is moved to
            the device.
        device: Where frames are encoded and networks learn. Simulations, GWR-B and replay stay on
            the CPU.

    Attributes:
        env: The world as the algorithm sees it, a composition of transforms.
        source: The transform that draws task and demonstration of each episode.
        simulation: The environment without its transforms.
        gwr: GWR-B, or None in an algorithm without it.
        groups: Groups of behaviors, or None in an algorithm that does not tell them apart.
        state_size: Number of features of the state.
        learner: The RL algorithm: losses of actor and critic, optimizer, target networks.
        replay: What was experienced.
        needs_label: Whether `freeze` and `act_frozen` depend on the label of a test episode's task.
        needs_replay: Whether `freeze` depends on the replay.
    """

    env: TransformedEnv
    gwr: GWRB | None = None
    groups: BehaviorGroups | None = None
    needs_label: bool = True
    needs_replay: bool = True
    learner: Learner
    replay: GroupReplay | TaskReplay

    def __init__(
        self,
        config: AlgorithmConfig,
        *,
        seeds: Sequence[int],
        schedule: TaskSchedule,
        bank: DemonstrationBank,
        encoders: Representation | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        self.device = torch.device(device)
        self.n_seeds, self.n_tasks = len(seeds), schedule.n_tasks
        self.state_size = STATE_SIZE
        if encoders is not None:
            encoders.vae.to(self.device)
            if config.state == "latent":
                self.state_size = encoders.vae.latent_size
        batch = torch.Size([self.n_seeds])
        self.source = DemonstrationSource(
            bank, schedule, batch_size=batch, generator=generators(seeds, "demonstrations")
        )
        self.simulation = NicoEnv(
            bank.tasks,
            batch_size=batch,
            seed=[stream_seed(seed, "env") for seed in seeds],
            observation="pixels" if config.state == "latent" else "state",
        )
        self._noise = generators(seeds, "exploration")

    @abstractmethod
    def act(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the ``action`` ``[S, 4]`` of the policy with exploration noise."""

    @abstractmethod
    def store(self, transition: TensorDictBase) -> None:
        """Keeps a transition of each seed, ``[S]``, for updates to come."""

    @abstractmethod
    def update(self) -> dict[str, Tensor]:
        """Makes one update of each seed from the transitions stored so far.

        Touches neither the environment nor what acting changes, so that it may run while the
        environment takes the step that has been chosen before.

        Returns:
            ``loss_actor``, ``loss_value`` and what else the RL algorithm minimizes, means over the
            seeds ``[]``; empty before the first update.
        """

    @abstractmethod
    def freeze(
        self, index: int, embedding: Tensor, task: Tensor, generator: torch.Generator
    ) -> dict[str, Any]:
        """Returns copies, on the CPU, of what the policy of one seed depends on in test episodes.

        Nothing is learned from the demonstrations, and nothing of the training changes.

        Args:
            index: Position of the seed in the batch.
            embedding: phi of the demonstration of each test episode, ``[T, M, 32]``.
            task: Their labels, int64 ``[T, M]``. BGPO does not read them.
            generator: For what the algorithm draws to prepare itself.

        Returns:
            Nested tensors, of the same shapes for all seeds of a run.
        """

    @abstractmethod
    def act_frozen(self, frozen: TensorDictBase, state: Tensor) -> Tensor:
        """Returns the actions of test episodes, without noise.

        Args:
            frozen: What `freeze` returned, of all seeds, stacked ``[S]``, on the device.
            state: What the policy sees, ``[S, T, M, features]``, on the device.

        Returns:
            ``[S, T, M, 4]``.
        """

    def compose(
        self,
        config: AlgorithmConfig,
        encoders: Representation | None,
        transforms: Sequence[Transform] = (),
        *,
        rewards: Sequence[str] = ("reward",),
    ) -> TransformedEnv:
        """Returns the world as the algorithm sees it.

        Args:
            config: Its hyperparameters.
            encoders: The trained encoders.
            transforms: What it adds, behind the draw of task and demonstration.
            rewards: What is summed over each episode, as ``episode_...``.
        """
        return TransformedEnv(
            self.simulation,
            Compose(
                [
                    observe(config, encoders),
                    StepCounter(config.max_steps),
                    self.source,
                    *transforms,
                    clip(config),
                    RewardSum(in_keys=list(rewards), out_keys=[f"episode_{r}" for r in rewards]),
                ]
            ),
        )

    def demonstrations(
        self,
        config: AlgorithmConfig,
        bank: DemonstrationBank,
        seeds: Sequence[int],
        constant_keys: Sequence[NestedKey] = (),
    ) -> DemonstrationReplay | None:
        """Returns the replay of shown demonstrations; None if the algorithm is not to use them.

        Args:
            config: Its hyperparameters.
            bank: The demonstrations of training episodes.
            seeds: The seeds.
            constant_keys: What policies read that is constant within an episode.

        Raises:
            ValueError: If the bank has no steps, or they are not of the state that policies see.
        """
        if not config.demonstration_share:
            return None
        if config.state != "latent":
            raise ValueError("demonstrations are latents: set demonstration_share to 0")
        return DemonstrationReplay(
            bank,
            generator=generators(seeds, "demonstration replay"),
            state_key=config.state,
            constant_keys=constant_keys,
        )

    def learn(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Takes a gradient step on a batch, and one of the target networks towards the others.

        Returns:
            What `update` returns.
        """
        losses = self.learner.learn(self.moved(batch))
        return {key: loss / self.n_seeds for key, loss in losses.items()}

    def moved(self, batch: TensorDictBase) -> TensorDictBase:
        """Returns a batch where the networks are."""
        return batch if self.device == torch.device("cpu") else batch.to(self.device)

    def state_dict(self) -> dict[str, Any]:
        """Returns all that the future of the run depends on but the tensordict in flight."""
        return {
            "source": dict(self.source.state_dict()),
            "simulation": self.simulation.simulation_state(),
            "noise": [generator.get_state() for generator in self._noise],
            **{name: dict(part.state_dict()) for name, part in self._learned().items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continues from what `state_dict` returned."""
        self.source.load_state_dict(state["source"])
        self.simulation.load_simulation_state(state["simulation"])
        for name, part in self._learned().items():
            part.load_state_dict(state[name])
        for generator, saved in zip(self._noise, state["noise"], strict=True):
            generator.set_state(saved)

    def _learned(self) -> dict[str, Any]:
        """Returns what changes by learning, which an algorithm need not have all of."""
        parts = ("learner", "replay")
        return {name: getattr(self, name) for name in parts if hasattr(self, name)}


def networks_of(parameters: TensorDictBase, seed: Tensor, task: Tensor) -> dict[str, Tensor]:
    """Returns some of the networks that there are for each task of each seed.

    Args:
        parameters: ``[S, T, ...]``.
        seed: Positions of the seeds, int64, of any shape that goes with that of ``task``.
        task: The tasks, int64.

    Returns:
        Parameters of that shape, by the names that `torch.func.functional_call` takes.
    """
    flat = parameters.flatten_keys(".")
    return {str(key): value[seed, task] for key, value in flat.items()}
