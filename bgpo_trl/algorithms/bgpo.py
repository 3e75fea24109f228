"""Behavior-Guided Policy Optimization (Alg. 1): GWR-B infers the task, f_RL learns the policy."""

from __future__ import annotations

from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import one_hot
from torchrl.envs import EnvBase, TransformedEnv

from bgpo_trl.algorithms.algorithm import Algorithm, Policy
from bgpo_trl.algorithms.environments import training_env
from bgpo_trl.algorithms.experts import ActiveGroups, Experts, GroupTrials
from bgpo_trl.algorithms.rl import Learner, LearnerSpec, make_learner
from bgpo_trl.configs import BGPOConfig
from bgpo_trl.data.bank import DemonstrationSteps
from bgpo_trl.data.demonstration_replay import DemonstrationReplay
from bgpo_trl.data.replay import GroupReplay
from bgpo_trl.modules.behavior_groups import BehaviorGroups
from bgpo_trl.modules.gwr import GWRB
from bgpo_trl.seeding import generators
from bgpo_trl.transforms import DemonstrationSource
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
        trials: Trials by which groups of one task are joined; None without experts or
            demonstrations.
    """

    config: BGPOConfig
    needs_replay = False

    def __init__(self, config: BGPOConfig, **arguments: Any) -> None:
        super().__init__(config, **arguments)
        seeds, embedding_size = self.seeds, self.bank.embedding.shape[-1]
        self.needs_label = config.context == "label"
        if config.context == "behavior":
            self.gwr = GWRB(
                embedding_size,
                config.gwr,
                batch_size=[len(seeds)],
                generator=generators(seeds, "gwr"),
            )
        if config.grouped:
            self.groups = BehaviorGroups(
                embedding_size,
                batch_size=[len(seeds)],
                smallest=config.group_size,
                evidence=config.group_evidence,
            )
        self._revision = torch.zeros(len(seeds), dtype=torch.int64)
        sizes = {None: 0, "label": self.n_tasks}
        context_size = sizes.get(config.context, embedding_size)
        self.in_keys = [config.state, *(["context"] if context_size else [])]

        rl, keys = config.rl, self.in_keys
        spec = LearnerSpec(
            seeds=seeds,
            in_keys=keys,
            in_features=self.state_size + context_size,
            action_size=self.scene.action_size,
            return_bounds=(0.0, self._highest_return()),
            device=self.device,
        )
        self.learner = self._make_learner(spec)
        n_active = config.active_groups if config.grouped else 1
        self.active = ActiveGroups(len(seeds), n_active, config.rest_after)
        self.experts: Experts | None = None
        if config.experts and (groups := self.groups) is not None:
            self.experts = Experts(self.learner, self.active, groups.parent)
        self.test_actor = self.learner.actor
        self.replay = GroupReplay(
            rl.replay_size,
            generator=generators(seeds, "replay"),
            keys=[*keys, "action", *(("next", key) for key in (keys[0], "reward", "terminated"))],
            source_key="demo_index" if config.grouped else None,
        )
        self.shown = self.demonstrations(keys[1:], own_constants=not config.experts)
        self.trials: GroupTrials | None = None
        if self.shown is not None and config.experts:
            steps = cast(DemonstrationSteps, self.bank.steps)
            starts = steps.latents(steps.first)
            self.trials = GroupTrials(starts, seeds=seeds, smallest=config.group_size)

    def _make_learner(self, spec: LearnerSpec) -> Learner:
        return make_learner(self.config.rl, spec)

    def make_env(self, base_env: EnvBase, source: DemonstrationSource) -> TransformedEnv:
        """Return the environment of training episodes, see `training_env`."""
        return training_env(
            self.config,
            base_env,
            source,
            self.encoders,
            state=self.scene.state,
            context=self.config.context,
            behavior_scale=self.config.behavior_scale,
            gwr=self.gwr,
            groups=self.groups,
            beta=self.beta,
        )

    @property
    def beta(self) -> float:
        """Weight of the intrinsic reward; 0 where there is no behavior to match."""
        return self.config.beta if self.config.context in ("behavior", "embedding") else 0.0

    def _highest_return(self) -> float:
        """Return the highest attainable return: a success now, or after the bonus of a time-out."""
        success = 1.0 + self.beta
        after = success if self.config.timeouts_bootstrap else 0.0
        return max(success, self.beta + self.config.rl.gamma * after)

    def _groups_of(self, tensordict: TensorDictBase) -> list[int]:
        return tensordict["group"].tolist() if self.config.grouped else [0] * self.n_seeds

    @torch.no_grad()
    def act(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the ``action`` ``[S, A]`` of the group's policy with exploration noise.

        Where groups have just been joined, the ``group`` of an episode that begins is updated.
        """
        groups = self._playing(tensordict)
        if self.experts is not None:
            expert = self.experts.play(groups)
        else:
            expert = torch.zeros(self.n_seeds, dtype=torch.int64)
            for seed, group in enumerate(groups):
                self.active.play(seed, group)
        seen = self.to_device(tensordict.select(*self.in_keys))
        return tensordict.set("action", self.learner.act(seen, self._noise, expert))

    def _playing(self, tensordict: TensorDictBase) -> list[int]:
        """Return the groups that act; update the groups of episodes that begin."""
        groups, trials = self._groups_of(tensordict), self.trials
        if trials is None or self.groups is None:
            return groups
        begins = tensordict["step_count"].flatten() == 0
        if begins.any():
            # The end of the last episode may have joined groups after the lookup of this one.
            match = self.groups.lookup(tensordict["demo_embedding"], begins)
            tensordict["group"] = torch.where(begins, match.group, tensordict["group"])
        for seed in begins.nonzero().flatten().tolist():
            start, group = tensordict[self.config.state][seed], int(tensordict["group"][seed])
            trials.begin(seed, start, group)
        return [trials.playing(seed) for seed in range(self.n_seeds)]

    def store(self, transition: TensorDictBase) -> None:
        """Store a transition of each seed and, at the end of an episode, its demonstration.

        Where demonstrations have changed their groups, all that is stored follows.
        """
        group = torch.tensor(self._groups_of(transition))
        self.replay.add(transition, group)
        if self.shown is not None:
            self._store_demonstration(self.shown, transition, group)
        self._join_groups(transition)
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

    def _join_groups(self, transition: TensorDictBase) -> None:
        """Count the episodes that end; join groups that turn out to be one task."""
        if self.trials is None or self.groups is None:
            return
        end = transition.get("next")
        for seed in end["done"].flatten().nonzero().flatten().tolist():
            success = bool(end["success"][seed])
            self.trials.end(seed, int(transition["demo_index"][seed]), success)
            pair = self.trials.same_task(seed)
            if pair is not None and {*pair} <= {*self.groups.numbers(seed)}:
                self.groups.join(seed, *pair)

    def _follow_groups(self) -> None:
        """Assign what is stored to the groups of today; put experts of former groups aside."""
        if self.groups is None or (changed := self.groups.revision != self._revision).sum() == 0:
            return
        self._revision = self.groups.revision
        shown = self.bank.embedding.expand(self.n_seeds, *self.bank.embedding.shape)
        group_of = self.groups.lookup(shown, changed).group
        for seed in changed.nonzero().flatten().tolist():
            for replay in (self.replay, self.shown):
                if replay is not None:
                    replay.regroup(seed, group_of[seed])
            known = self.groups.numbers(seed)
            if self.trials is not None:
                self.trials.regroup(seed, group_of[seed], known)
            for group in [*self.active.groups[seed]]:
                if group not in known:
                    (self.experts or self.active).rest(seed, group)

    def update(self) -> dict[str, Tensor]:
        """Make one update of each seed."""
        if len(self.replay) < self.config.rl.warmup_steps:
            return {}
        config, active = self.config, self.active
        if config.experts:
            return self.learn(
                self.sample(
                    lambda n: active.group.unsqueeze(-1).expand(-1, -1, n), config.expert_batch_size
                )
            )
        return self.learn(self.sample(lambda n: active.rows(n).unsqueeze(1), config.rl.batch_size))

    @torch.no_grad()
    def snapshot(
        self, index: int, embedding: Tensor, task: Tensor, generator: torch.Generator
    ) -> Policy:
        """Copy the policy of one seed; with experts, that of each episode, ``[T, M, ...]``."""
        del generator
        if self.experts is not None and self.groups is not None:
            shown = embedding.expand(self.n_seeds, *embedding.shape)
            group = self.groups.lookup(shown).group[index]
            numbers = group.unique().tolist()
            experts = {number: self.actor_weights(index, number) for number in numbers}
            each = [experts[number] for number in group.flatten().tolist()]
            parameters = {
                key: torch.stack([weights[key] for weights in each]).unflatten(0, group.shape)
                for key in each[0]
            }
        else:
            parameters = self.actor_weights(index)
        context = self.context(index, embedding, task)
        return self.policy(parameters, context)

    def actor_weights(self, index: int, group: int = 0) -> dict[str, Tensor]:
        """Copy the weights of the policy of one seed to the CPU; with experts, that of a group."""
        if self.experts is not None:
            return self.experts.actor_weights(index, group)
        return self.learner.actor_weights(self.learner.read(index, 0))

    def context(self, index: int, embedding: Tensor, task: Tensor) -> Tensor | None:
        """Return the context of test episodes, ``[*B, C]``; None for a policy without context.

        ``embedding`` is ``[*B, 32]``. The labels ``[*B]`` are read if they are the context.
        """
        if self.config.context is None:
            return None
        if self.needs_label:
            return one_hot(task, self.n_tasks).float()
        behavior = embedding
        if self.gwr is not None:
            only = torch.arange(self.n_seeds) == index
            shown = embedding.expand(self.n_seeds, *embedding.shape)
            behavior = self.gwr.lookup(shown, mask=only).embedding[index]
        return self.config.behavior_scale * behavior

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a `state_dict`."""
        super().load_state_dict(state)
        if self.groups is not None:
            self._revision = self.groups.revision

    def _learned(self) -> dict[str, Any]:
        # Experts come first, since they determine the shape of the learner's networks.
        played = {"active": self.active} if self.experts is None else {"experts": self.experts}
        parts = {"gwr": self.gwr, "groups": self.groups, "trials": self.trials}
        found = {key: part for key, part in parts.items() if part is not None}
        return {**played, **super()._learned(), **found}
