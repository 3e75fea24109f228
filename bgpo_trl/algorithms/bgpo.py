"""Behavior-Guided Policy Optimization (Alg. 1): GWR-B tells the task, f_RL learns to do it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torch.func import functional_call
from torch.nn.functional import one_hot
from torchrl.envs import (
    ObservationNorm,
    Transform,
    UnaryTransform,
)

from bgpo_trl.algorithms.algorithm import Algorithm
from bgpo_trl.algorithms.rl import Problem, make_learner
from bgpo_trl.configs import BGPOConfig
from bgpo_trl.demonstrations import DemonstrationBank
from bgpo_trl.modules.gwr import GWRB
from bgpo_trl.modules.sequence_autoencoder import SequenceAutoencoder
from bgpo_trl.replay import ReplayBuffer
from bgpo_trl.representation import Representation
from bgpo_trl.seeding import generators
from bgpo_trl.transforms import BehaviorLookup, BehaviorMatchingReward, TaskSchedule


@dataclass(frozen=True)
class Parts:
    """What the transforms of a variant are made of."""

    beta: float
    """Weight of the intrinsic reward."""
    n_tasks: int
    """Length of a label's one-hot vector."""
    gwr: GWRB
    """One network a seed."""
    lae: SequenceAutoencoder | None
    """The sequence encoder, if there are encoders."""

    def behavior_matching_reward(self) -> BehaviorMatchingReward:
        """Returns the transform that pays the intrinsic reward.

        Raises:
            ValueError: If there are no encoders.
        """
        if self.lae is None:
            raise ValueError("matching behaviors needs trained encoders")
        return BehaviorMatchingReward(self.lae, beta=self.beta)


@dataclass(frozen=True)
class Composition:
    """What the policy is told to do, and what it is paid for beside the task."""

    infer: Sequence[Transform] = ()
    """From ``demo_embedding`` (or, for a reference, ``task``) to what the policy is told."""
    reward: Sequence[Transform] = ()
    """What changes the reward."""
    told: NestedKey | None = "behavior"
    """The entry that the policy is told; ``behavior`` is standardised for it. None: nothing."""


def self_organized(parts: Parts) -> Composition:
    """BGPO itself: the policy is told the behavior that GWR-B finds, and paid for matching it."""
    return Composition(
        infer=[BehaviorLookup(parts.gwr, learn=True)], reward=[parts.behavior_matching_reward()]
    )


def labeled(parts: Parts) -> Composition:
    """The upper reference: the policy is told the task's label."""

    def label(task: Tensor) -> Tensor:
        return one_hot(task, parts.n_tasks).float()

    return Composition(
        infer=[UnaryTransform(["task"], ["task_one_hot"], fn=label)], told="task_one_hot"
    )


def untold(parts: Parts) -> Composition:
    """The lower reference, plain DDPG: the policy is told nothing."""
    del parts
    return Composition(told=None)


class BGPO(Algorithm):
    """BGPO, its ablations and the references without GWR-B, which differ by their transforms.

    Args:
        config: Hyperparameters.
        seeds: One for each element of the batch; they share nothing but the encoders.
        schedule: Which tasks are presented when.
        bank: Embedded demonstrations for training episodes.
        encoders: The trained encoders; None where neither latents nor embeddings are used.
        device: As in `Algorithm`.
        compose: Makes the transforms in which the variants differ.

    Attributes:
        env: The composition of transforms.
        gwr: GWR-B, or None in the variants without it.
        actor: The policy, ``[S]`` stacked.
        loss: The RL algorithm's, with the critics.
    """

    needs_replay = False

    def __init__(
        self,
        config: BGPOConfig,
        *,
        seeds: Sequence[int],
        schedule: TaskSchedule,
        bank: DemonstrationBank,
        encoders: Representation | None = None,
        device: torch.device | str = "cpu",
        compose: Callable[[Parts], Composition] = self_organized,
    ) -> None:
        super().__init__(
            config, seeds=seeds, schedule=schedule, bank=bank, encoders=encoders, device=device
        )
        self.config = config
        embedding_size = bank.embedding.shape[-1]
        parts = Parts(
            beta=config.beta,
            n_tasks=schedule.n_tasks,
            gwr=GWRB(embedding_size, batch_size=[len(seeds)], generator=generators(seeds, "gwr")),
            lae=None if encoders is None else encoders.lae,
        )
        composition = compose(parts)
        self.infer = list(composition.infer)
        self.told = composition.told
        self.needs_label = self.told == "task_one_hot"
        if self.told == "behavior":
            # The distances that GWR-B needs are not those that a network learns well from.
            normalize = ObservationNorm(
                bank.embedding.mean(0),
                bank.embedding.std(0).clamp_min(1e-6),
                in_keys=["behavior"],
                out_keys=["normalized_behavior"],
                standard_normal=True,
            )
            self.infer.append(normalize)
            self.told = "normalized_behavior"
        bonuses = [t for t in composition.reward if isinstance(t, BehaviorMatchingReward)]
        rewards = ["reward", *(["extrinsic_reward", "intrinsic_reward"] if bonuses else [])]
        self.env = self.compose(
            config, encoders, [*self.infer, *composition.reward], rewards=rewards
        )
        lookups = [t for t in composition.infer if isinstance(t, BehaviorLookup)]
        self.gwr = lookups[0].gwr if lookups else None
        told_size = {None: 0, "task_one_hot": schedule.n_tasks}.get(self.told, embedding_size)
        self.in_keys = [config.state, *([] if self.told is None else [self.told])]
        rl, keys = config.rl, self.in_keys
        self.learner = make_learner(
            rl,
            Problem(
                seeds=seeds,
                in_keys=keys,
                in_features=self.state_size + told_size,
                return_bounds=(0.0, 1.0 + sum(t.beta for t in bonuses)),
                device=self.device,
            ),
        )
        self.actor, self.loss = self.learner.actor, self.learner.loss
        self.replay = ReplayBuffer(
            rl.replay_size,
            batch_size=rl.batch_size,
            generator=generators(seeds, "replay"),
            keys=[*keys, "action", *(("next", key) for key in (keys[0], "reward", "terminated"))],
        )

    @torch.no_grad()
    def act(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the ``action`` ``[S, 4]`` by which the policy explores."""
        seen = self.moved(tensordict.select(*self.in_keys))
        return tensordict.set("action", self.learner.act(seen, self._noise))

    def store(self, transition: TensorDictBase) -> None:
        """Keeps a transition of each seed for updates to come."""
        self.replay.add(transition)

    def update(self) -> dict[str, Tensor]:
        """Makes one update of each seed; see `Algorithm.update`."""
        if len(self.replay) < self.config.rl.warmup_steps:
            return {}
        return self.learn(self.replay.sample())

    @torch.no_grad()
    def freeze(
        self, index: int, embedding: Tensor, task: Tensor, generator: torch.Generator
    ) -> dict[str, Any]:
        """Returns the actor's weights, and what it is told in each test episode ``[T, M, told]``.

        See `Algorithm.freeze`. The task is only read by the variant that is told the label.
        """
        weights = self.actor.state_dict()
        frozen: dict[str, Any] = {
            "actor": {key: stacked[index].to("cpu", copy=True) for key, stacked in weights.items()}
        }
        if self.told is not None:
            # All seeds look the same demonstrations up: GWR-B knows only whole batches.
            shown = {"demo_embedding": embedding, "task": task}
            batch = TensorDict(shown, task.shape).expand(self.n_seeds, *task.shape)
            batch = batch.clone()
            for transform in self.infer:
                batch = transform(batch)
            frozen["told"] = batch[self.told][index].clone()
        return frozen

    def act_frozen(self, frozen: TensorDictBase, state: Tensor) -> Tensor:
        """Returns the actions of test episodes; see `Algorithm.act_frozen`."""
        inputs = TensorDict({self.in_keys[0]: state}, state.shape[:-1])
        if self.told is not None:
            inputs.set(self.told, frozen["told"])
        functional_call(self.actor, dict(frozen.get("actor").items()), (inputs,))
        return inputs["action"]

    def state_dict(self) -> dict[str, Any]:
        """Returns all that the future of the run depends on but the tensordict in flight."""
        return {
            **super().state_dict(),
            "gwr": None if self.gwr is None else dict(self.gwr.state_dict()),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continues from what `state_dict` returned."""
        super().load_state_dict(state)
        if self.gwr is not None:
            self.gwr.load_state_dict(state["gwr"])
