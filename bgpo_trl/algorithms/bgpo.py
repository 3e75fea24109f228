"""Behavior-Guided Policy Optimization (Alg. 1): GWR-B infers the task, f_RL learns to do it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, cast

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torch.func import functional_call
from torch.nn.functional import one_hot
from torchrl.envs import ObservationNorm, Transform, UnaryTransform

from bgpo_trl.algorithms.algorithm import Algorithm
from bgpo_trl.algorithms.experts import ActiveGroups, Experts
from bgpo_trl.algorithms.rl import Problem, make_learner
from bgpo_trl.configs import BGPOConfig
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.data.demonstration_replay import DemonstrationReplay
from bgpo_trl.data.group_replay import GroupReplay
from bgpo_trl.encoders.representation import Representation
from bgpo_trl.modules.behavior_groups import BehaviorGroups
from bgpo_trl.modules.gwr import GWRB
from bgpo_trl.modules.sequence_autoencoder import SequenceAutoencoder
from bgpo_trl.seeding import generators
from bgpo_trl.transforms import (
    BehaviorLookup,
    BehaviorMatchingReward,
    GroupLookup,
    TaskSchedule,
)


@dataclass(frozen=True)
class Parts:
    """Material for the transforms of a variant."""

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
    context: NestedKey | None = "behavior"
    """The entry that tells the policy what to do. None: nothing does."""


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
        infer=[UnaryTransform(["task"], ["task_one_hot"], fn=label)], context="task_one_hot"
    )


def no_context(parts: Parts) -> Composition:
    """The lower reference, plain DDPG: the policy is told nothing."""
    del parts
    return Composition(context=None)


class BGPO(Algorithm):
    """BGPO, its ablations and the references without GWR-B, which differ by their transforms.

    With ``config.experts``, each group of behaviors has an actor and a critic of its own; with
    ``config.even_replay``, an update sees as many transitions of each of the groups played last;
    with a ``config.demonstration_share``, a part of them is taken from demonstrations. Without the
    three it is the paper's algorithm.

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
        groups: Groups of behaviors, or None where they are not told apart.
        experts: The networks, by group; without experts, of one group.
        shown: Replay of the demonstrations that were shown, or None where they are not used.
    """

    needs_replay = False
    replay: GroupReplay

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
        embedding_size, batch = bank.embedding.shape[-1], [len(seeds)]
        streams = generators(seeds, "gwr")
        parts = Parts(
            beta=config.beta,
            n_tasks=schedule.n_tasks,
            gwr=GWRB(embedding_size, batch_size=batch, generator=streams, **asdict(config.gwr)),
            lae=None if encoders is None else encoders.lae,
        )
        composition = compose(parts)
        self.infer = list(composition.infer)
        self.context, context_size = composition.context, embedding_size
        self.needs_label = self.context == "task_one_hot"
        if self.needs_label:
            context_size = schedule.n_tasks
        elif self.context is None:
            context_size = 0
        else:
            # Policies read b beside latents of unit scale, which it must not drown.
            behavior, self.context = self.context, "context"
            self.infer.append(
                ObservationNorm(0.0, config.behavior_scale, [behavior], [self.context])
            )
        grouping: list[Transform] = []
        if config.grouped:
            self.groups = BehaviorGroups(embedding_size, batch_size=batch, **asdict(config.groups))
            grouping.append(GroupLookup(self.groups, learn=True))
        bonuses = [t for t in composition.reward if isinstance(t, BehaviorMatchingReward)]
        rewards = ["reward", *(["extrinsic_reward", "intrinsic_reward"] if bonuses else [])]
        self.env = self.compose(
            config, encoders, [*self.infer, *grouping, *composition.reward], rewards=rewards
        )
        self._beta = sum(t.beta for t in bonuses)
        lookups = [t for t in composition.infer if isinstance(t, BehaviorLookup)]
        self.gwr = lookups[0].gwr if lookups else None
        self.in_keys = [config.state, *([] if self.context is None else [self.context])]
        rl, keys = config.rl, self.in_keys

        n_slots = config.active_groups if config.grouped else 1
        n_experts = n_slots if config.experts else 1
        self.learner = make_learner(
            rl,
            Problem(
                seeds=seeds,
                in_keys=keys,
                in_features=self.state_size + context_size,
                return_bounds=(0.0, self._highest_return()),
                device=self.device,
                experts=range(n_experts),
            ),
        )
        self._active = ActiveGroups(len(seeds), n_slots)
        self.experts = Experts(
            self.learner,
            self._active if config.experts else ActiveGroups(len(seeds), 1),
            lambda seed, group: 0 if self.groups is None else self.groups.parent(seed, group),
        )
        self.replay = GroupReplay(
            rl.replay_size,
            generator=generators(seeds, "replay"),
            keys=[*keys, "action", *(("next", key) for key in (keys[0], "reward", "terminated"))],
        )
        self.shown = self.demonstrations(config, bank, seeds, constant_keys=keys[1:])

    def _highest_return(self) -> float:
        """Returns the highest attainable return: of a success now, or after a time-out's bonus."""
        success = 1.0 + self._beta
        return max(success, self._beta + self.config.rl.gamma * success)

    def _groups_of(self, tensordict: TensorDictBase) -> list[int]:
        return tensordict["group"].tolist() if self.config.grouped else [0] * self.n_seeds

    @torch.no_grad()
    def act(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the ``action`` ``[S, 4]`` by which the policy explores."""
        groups = self._groups_of(tensordict)
        if self.config.experts:
            expert = self.experts.play(groups)
        else:
            expert = torch.zeros(self.n_seeds, dtype=torch.int64)
            for seed, group in enumerate(groups):
                self._active.play(seed, group)
        seen = self.moved(tensordict.select(*self.in_keys))
        return tensordict.set("action", self.learner.act(seen, self._noise, expert))

    def store(self, transition: TensorDictBase) -> None:
        """Keeps a transition of each seed for updates to come, and the demonstration at its end."""
        group = torch.tensor(self._groups_of(transition))
        self.replay.add(transition, group)
        if self.shown is None:
            return
        ended = transition.get(("next", "done")).flatten()
        if ended.any():
            reward = torch.ones(self.n_seeds)
            if self._beta:
                error = transition["behavior"] - transition["demo_embedding"]
                reward += self._beta * torch.exp(-torch.linalg.vector_norm(error, dim=-1))
            self.shown.add(transition, reward, group, ended)

    def update(self) -> dict[str, Tensor]:
        """Makes one update of each seed; see `Algorithm.update`."""
        if len(self.replay) < self.config.rl.warmup_steps:
            return {}
        return self.learn(self._sample())

    def _sample(self) -> TensorDictBase:
        """Returns the transitions of an update, ``[S, E, B]``."""
        config, (_, n_experts) = self.config, self.experts.active.group.shape
        n_rows = config.expert_batch_size if config.experts else config.rl.batch_size

        def groups_of(n_rows: int) -> Tensor:
            if config.experts:
                return self._active.group.repeat_interleave(n_rows, 1)
            return self._active.rows(n_rows)

        def draw(replay: GroupReplay | DemonstrationReplay, n_rows: int) -> TensorDict:
            return replay.sample(groups_of(n_rows)).view(self.n_seeds, n_experts, n_rows)

        if self.shown is None or not len(self.shown):
            return draw(self.replay, n_rows)
        n_shown = round(config.demonstration_share * n_rows)
        played, shown = draw(self.replay, n_rows - n_shown), draw(self.shown, n_shown)
        return cast(TensorDictBase, torch.cat([played, shown], -1))

    @torch.no_grad()
    def freeze(
        self, index: int, embedding: Tensor, task: Tensor, generator: torch.Generator
    ) -> dict[str, Any]:
        """Returns the weights and the context of the policy of each test episode, ``[T, M, ...]``.

        See `Algorithm.freeze`. A policy that is the same for all is returned as ``[1, 1, ...]``.
        The task is only read by the variant that is told the label.
        """
        del generator
        group = torch.zeros(1, 1, dtype=torch.int64)
        if self.config.experts and self.groups is not None:
            shown = embedding.expand(self.n_seeds, *embedding.shape)
            group = self.groups.lookup(shown).group[index]
        experts = {
            number: self.experts.actor_weights(index, number) for number in group.unique().tolist()
        }
        each = [experts[number] for number in group.flatten().tolist()]
        frozen: dict[str, Any] = {
            "actor": {
                key: torch.stack([weights[key] for weights in each]).unflatten(0, group.shape)
                for key in each[0]
            }
        }
        if self.context is not None:
            # All seeds look the same demonstrations up: GWR-B knows only whole batches.
            shown = {"demo_embedding": embedding, "task": task}
            batch = TensorDict(shown, task.shape).expand(self.n_seeds, *task.shape)
            batch = batch.clone()
            for transform in self.infer:
                batch = transform(batch)
            frozen["context"] = batch[self.context][index].clone()
        return frozen

    def act_frozen(self, frozen: TensorDictBase, state: Tensor) -> Tensor:
        """Returns the actions of test episodes; see `Algorithm.act_frozen`."""
        batch = state.shape[:-1]
        inputs = TensorDict({self.in_keys[0]: state}, batch)
        if self.context is not None:
            inputs.set(self.context, frozen["context"])
        weights = {
            key: value.expand(*batch, *value.shape[len(batch) :])
            for key, value in frozen.get("actor").items()
        }
        functional_call(self.learner.actor, weights, (inputs,))
        return inputs["action"]

    def state_dict(self) -> dict[str, Any]:
        """Returns all that the future of the run depends on but the tensordict in flight."""
        state = {**super().state_dict(), "experts": self.experts.state_dict()}
        state["active"] = self._active.state_dict()
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continues from what `state_dict` returned."""
        super().load_state_dict(state)
        self.experts.load_state_dict(state["experts"])
        self._active.load_state_dict(state["active"])

    def _learned(self) -> dict[str, Any]:
        parts = {"gwr": self.gwr, "groups": self.groups, "shown": self.shown}
        return super()._learned() | {key: part for key, part in parts.items() if part is not None}
