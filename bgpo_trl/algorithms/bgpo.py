"""Behavior-Guided Policy Optimization (Alg. 1): GWR-B infers the task, f_RL learns the policy."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.nn.functional import one_hot
from torchrl.envs import ObservationNorm, RenameTransform, Transform, UnaryTransform

from bgpo_trl.algorithms.algorithm import Algorithm, Policy
from bgpo_trl.algorithms.experts import ActiveGroups, Experts
from bgpo_trl.algorithms.rl import Learner, LearnerSpec, make_learner
from bgpo_trl.configs import BGPOConfig
from bgpo_trl.data.bank import DemonstrationSteps
from bgpo_trl.data.demonstration_replay import DemonstrationReplay
from bgpo_trl.modules.behavior_groups import BehaviorGroups
from bgpo_trl.modules.gwr import GWRB
from bgpo_trl.seeding import generators, stream_seed
from bgpo_trl.transforms import BehaviorLookup, GroupLookup
from bgpo_trl.transforms.behavior_matching import matching_reward


class BGPO(Algorithm):
    """BGPO, its ablations and its references, which differ by ``config`` alone.

    ``context`` is what policies know of the task. With ``experts``, each group of behaviors has its
    own actor and critic; with ``group_balanced_replay``, an update draws equally from the groups
    played last; with a ``demonstration_share``, it also draws from demonstrations. Without these
    three, it is the paper's algorithm; ``bgpo-paper`` has the paper's settings too.

    Arguments as for `Algorithm`; encoders may be None if neither latents nor embeddings are used.

    Attributes:
        active: The groups played lately.
        experts: The networks of each group; None for one pair of networks.
        starts: First latent of each demonstration, ``[N, 64]``, by which other groups' experts are
            tried (`BehaviorGroups`); None without experts or demonstrations.
    """

    config: BGPOConfig
    needs_replay = False

    def __init__(self, config: BGPOConfig, **arguments: Any) -> None:
        super().__init__(config, **arguments)
        seeds, embedding_size = self.seeds, self.bank.embedding.shape[-1]
        self.needs_label = config.context == "label"
        self.takes_new_tasks = not self.needs_label  # A network that reads labels has a fixed size.
        self.beta = config.beta if config.context in ("behavior", "embedding") else 0.0
        if config.context == "behavior":
            self.gwr = GWRB(
                embedding_size,
                config.gwr,
                batch_size=[len(seeds)],
                generator=generators(seeds, "gwr"),
            )
        if config.grouped:
            self.groups = [
                BehaviorGroups(
                    embedding_size,
                    smallest=config.group_size,
                    evidence=config.group_evidence,
                    seed=stream_seed(seed, "trials"),
                )
                for seed in seeds
            ]
        self._revision = [0] * len(seeds)
        sizes = {None: 0, "label": self.n_tasks}
        context_size = sizes.get(config.context, embedding_size)
        self.in_keys = [config.observed, *(["context"] if context_size else [])]

        keys = self.in_keys
        spec = LearnerSpec(
            seeds=seeds,
            in_keys=keys,
            in_features=self.state_size + context_size,
            action_size=self.scene.action_size,
            return_bounds=(0.0, self._highest_return()),
            device=self.device,
        )
        self.learner = self.make_learner(spec)
        n_active = config.active_groups if config.grouped else 1
        self.active = ActiveGroups(len(seeds), n_active, config.rest_after)
        self.experts: Experts | None = None
        if config.experts:
            self.experts = Experts(
                self.learner, self.active, lambda seed, group: self.groups[seed].parent[group]
            )
        self.test_actor = self.learner.policy
        source_key = "demo_index" if config.grouped else None
        self.replay = self.make_replay(keys[1:], source_key)
        self.shown = self.demonstrations(keys[1:], own_constants=not config.experts)
        self.starts: Tensor | None = None
        if self.shown is not None and config.experts:
            steps = cast(DemonstrationSteps, self.bank.steps)
            self.starts = steps.latents(steps.first)
        self.conditioning = self._conditioning()

    def _conditioning(self) -> list[Transform]:
        """Return the transforms by which policies are conditioned on a demonstration.

        Within an environment, GWR-B and groups learn from it when the episode ends. Called on a
        TensorDict, the same transforms only look up.
        """
        context, n_tasks, transforms = self.config.context, self.n_tasks, list[Transform]()
        if self.gwr is not None:
            transforms.append(BehaviorLookup(self.gwr, learn=True))  # demo_embedding -> behavior
        elif context == "embedding":
            transforms.append(RenameTransform(["demo_embedding"], ["behavior"], create_copy=True))
        if self.groups:  # -> group, expert
            transforms.append(GroupLookup(self.groups, learn=True, starts=self.starts))
        if context == "label":
            transforms.append(
                UnaryTransform(
                    ["task"], ["context"], fn=lambda task: one_hot(task, n_tasks).float()
                )
            )
        elif context is not None:
            scale = self.config.behavior_scale
            transforms.append(ObservationNorm(0.0, scale, ["behavior"], ["context"]))
        return transforms

    def make_learner(self, spec: LearnerSpec) -> Learner:
        """Return the learner; an own RL algorithm overrides this."""
        return make_learner(self.config.rl, spec)

    def _highest_return(self) -> float:
        """Return the highest attainable return: a success now, or after the bonus of a time-out."""
        success = 1.0 + self.beta
        after = success if self.config.timeouts_bootstrap else 0.0
        return max(success, self.beta + self.config.rl.gamma * after)

    def _number(self, tensordict: TensorDictBase, key: str) -> Tensor:
        """Return an entry of `GroupLookup`, int64 ``[S]``; 0 without groups."""
        if self.groups:
            return tensordict[key]
        return torch.zeros(self.n_seeds, dtype=torch.int64)

    @torch.no_grad()
    def act(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the ``action`` ``[S, A]`` of the episode's ``expert`` with exploration noise."""
        groups = self._number(tensordict, "expert").tolist()
        return tensordict.set("action", self.act_by(tensordict, groups, self._play(groups)))

    def _play(self, groups: Sequence[int]) -> Tensor:
        """Activate the group of each seed's episode; return its place in the stack, ``[S]``."""
        if self.experts is not None:
            return self.experts.play(groups)
        for seed, group in enumerate(groups):
            self.active.play(seed, group)
        return torch.zeros(self.n_seeds, dtype=torch.int64)

    def store(self, transition: TensorDictBase) -> None:
        """Store a transition of each seed and, at the end of an episode, its demonstration.

        Where demonstrations have changed their groups, all that is stored follows.
        """
        group = self._number(transition, "group")
        self.replay.add(transition, group)
        if self.shown is not None:
            self._store_demonstration(self.shown, transition, group)
        self.count_episodes(transition, group)
        self._follow_groups()

    def _store_demonstration(
        self, shown: DemonstrationReplay, transition: TensorDictBase, group: Tensor
    ) -> None:
        ended = transition.get(("next", "done")).flatten()
        if ended.any():
            reward = torch.ones(self.n_seeds)
            if self.beta:
                phi = transition["demo_embedding"]
                reward += self.beta * matching_reward(transition["behavior"], phi)
            shown.add(transition, reward, group, ended)

    def _follow_groups(self) -> None:
        """Assign what is stored to the groups of today; put experts of former groups aside."""
        for seed, groups in enumerate(self.groups):
            if groups.revision == self._revision[seed]:
                continue
            self._revision[seed] = groups.revision
            group_of = groups.lookup(self.bank.embedding).group
            for replay in (self.replay, self.shown):
                if replay is not None:
                    replay.regroup(seed, group_of)
            if self.proposals is not None:
                self.proposals.follow(seed, groups.numbers, group_of.tolist())
            for group in [*self.active.groups[seed]]:
                if group not in groups.numbers:
                    (self.experts or self.active).rest(seed, group)

    def update(self) -> dict[str, Tensor]:
        """Make one update of each seed."""
        if len(self.replay) < self.config.rl.warmup_steps:
            return {}
        return self._learn_active()

    def learn_offline(self, rows: Tensor, n_updates: int) -> Iterator[dict[str, Tensor]]:
        """Learn from demonstrations, and logged episodes if any, before the first episode.

        GWR-B and groups first learn all demonstrations, so that these are stored with the behaviors
        and groups at the end. Then each seed makes its updates: its groups come to play one after
        the other, in the order of their numbers, each for as many. Groups before them learn on
        while they are active (``active_groups``).

        Args:
            rows: Positions in the bank, in the order of each seed, int64 ``[N, S]``.
            n_updates: Updates of each seed.

        Yields:
            The losses of each update.

        Raises:
            ValueError: Without a ``demonstration_share``.
        """
        if self.shown is None:
            raise ValueError("offline updates need a demonstration_share above 0")
        with torch.no_grad():
            for row in rows:
                phi = self.bank.embedding[row]
                if self.gwr is not None:
                    self.gwr.adapt(phi)
                for groups, own, at in zip(self.groups, phi, row.tolist(), strict=False):
                    groups.adapt(own, None if self.starts is None else self.starts[at])
            for row in rows:
                episode = self._episode_of(row)
                self._store_demonstration(self.shown, episode, self._number(episode, "group"))
        self._follow_groups()
        numbers = [groups.numbers for groups in self.groups] or [[0]] * self.n_seeds
        for update in range(n_updates):
            with torch.no_grad():
                self._play([of_seed[update * len(of_seed) // n_updates] for of_seed in numbers])
            yield self._learn_active(share=None if len(self.replay) else 1.0)

    def _episode_of(self, rows: Tensor) -> TensorDictBase:
        """Return the end of an episode that showed one demonstration of each seed, ``[S]``."""
        bank = self.bank
        shown = {"demo_embedding": bank.embedding[rows], "task": bank.task[rows]}
        ended = torch.ones(self.n_seeds, 1, dtype=torch.bool)
        episode: TensorDictBase = TensorDict(
            {**shown, "demo_index": rows, "next": {"done": ended}}, [self.n_seeds]
        )
        for transform in self.conditioning:
            episode = transform(episode)
        return episode

    def _learn_active(self, share: float | None = None) -> dict[str, Tensor]:
        """Make an update of the active groups of each seed; for ``share``, see `sample`."""
        config, active = self.config, self.active
        n_rows = config.expert_batch_size if config.experts else config.rl.batch_size

        def groups(n: int) -> Tensor:
            if config.experts:
                return active.group.unsqueeze(-1).expand(-1, -1, n)
            return active.rows(n).unsqueeze(1)

        return self.learn(self.sample(groups, n_rows, share=share))

    @torch.no_grad()
    def snapshot(
        self, index: int, embedding: Tensor, task: Tensor, generator: torch.Generator
    ) -> Policy:
        """Copy the policies of one seed, with experts those of the demonstrations' groups."""
        del generator
        given = self.condition(index, embedding, task)
        group = torch.zeros_like(task) if self.experts is None else given["group"]
        numbers, network = group.unique(return_inverse=True)
        each = [self.actor_weights(index, number) for number in numbers.tolist()]
        parameters = {key: torch.stack([one[key] for one in each]) for key in each[0]}
        return self.policy(parameters, given.get("context", None), network)

    def actor_weights(self, index: int, group: int = 0) -> dict[str, Tensor]:
        """Copy the weights of the policy of a group of one seed to the CPU."""
        only_clone = self.proposals is not None and self.proposals.clone_is_better(index, group)
        if self.experts is not None:
            return self.learner.expert_weights(self.experts.find(index, group), only_clone)
        return self.learner.expert_weights(self.learner.read(index, 0), only_clone)

    def state_dict(self) -> dict[str, Any]:
        """Return everything that future actions, updates and snapshots depend on."""
        return {**super().state_dict(), "groups": [groups.state_dict() for groups in self.groups]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a `state_dict`."""
        super().load_state_dict(state)
        for groups, saved in zip(self.groups, state["groups"], strict=True):
            groups.load_state_dict(saved)
        self._revision = [groups.revision for groups in self.groups]

    def _learned(self) -> dict[str, Any]:
        # Experts come first, since they determine the shape of the learner's networks.
        played = {"active": self.active} if self.experts is None else {"experts": self.experts}
        gwr = {} if self.gwr is None else {"gwr": self.gwr}
        return {**played, **super()._learned(), **gwr}
