"""Base class of all algorithms: the interface to training and test episodes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.func import functional_call
from torchrl.envs import Compose, EnvBase, RewardSum, StepCounter, Transform, TransformedEnv

from bgpo_trl.algorithms.observation import bound, encode, observed_size
from bgpo_trl.algorithms.proposal_trials import ProposalTrials
from bgpo_trl.algorithms.rl import Learner
from bgpo_trl.configs import AlgorithmConfig
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.data.demonstration_replay import DemonstrationReplay
from bgpo_trl.data.replay import GroupReplay
from bgpo_trl.encoders.representation import Representation
from bgpo_trl.modules.behavior_groups import BehaviorGroups
from bgpo_trl.modules.gwr import GWRB
from bgpo_trl.scenes import Scene, find_scene
from bgpo_trl.seeding import generators
from bgpo_trl.transforms import BehaviorMatchingReward, DemonstrationSource


@dataclass(frozen=True)
class Policy:
    """Snapshot of a policy for test episodes, unaffected by further training.

    Attributes:
        actor: Network, called with ``parameters`` instead of its weights.
        state_key: Key of the state.
        parameters: By name in the actor, those of one network, or of several, ``[U, ...]``.
        context: Input besides the state, ``[*B, C]``; None if the actor reads no context.
        network: Which of the ``U`` networks plays each episode, int64 ``[*B]``; None for one.
    """

    actor: TensorDictModuleBase
    state_key: NestedKey
    parameters: dict[str, Tensor]
    context: Tensor | None = None
    network: Tensor | None = None

    def to(self, device: torch.device | str) -> Policy:
        """Return the policy with weights and context on a device; ``network`` stays on the CPU."""
        return replace(
            self,
            parameters={key: value.to(device) for key, value in self.parameters.items()},
            context=None if self.context is None else self.context.to(device),
        )

    @torch.no_grad()
    def act(self, state: Tensor) -> Tensor:
        """Return actions ``[*B, A]`` in [-1, 1] for states ``[*B, features]``."""
        inputs: TensorDictBase = TensorDict({self.state_key: state}, state.shape[:-1])
        if self.context is not None:
            inputs["context"] = self.context
        if self.network is None:
            return functional_call(self.actor, self.parameters, (inputs,))["action"]
        network, inputs = self.network.flatten(), inputs.reshape(-1)
        rows, actions = list[Tensor](), list[Tensor]()
        for number in network.unique().tolist():
            rows.append((network == number).nonzero().flatten())
            weights = {key: value[number] for key, value in self.parameters.items()}
            played = functional_call(self.actor, weights, (inputs[rows[-1].to(state.device)],))
            actions.append(played["action"])
        order = torch.cat(rows).argsort().to(state.device)
        return torch.cat(actions)[order].view(*self.network.shape, -1)

    def state_dict(self) -> dict[str, Any]:
        """Return the arguments of `Algorithm.policy`."""
        return {"parameters": self.parameters, "context": self.context, "network": self.network}


class Algorithm(ABC):
    """A multi-task learner for a batch of seeds that share nothing but the encoders.

    A training step is `act`, the environment's step and `store`; an `update` may run while the
    environment steps. `snapshot` copies the policy of one seed for test episodes. The simulation
    belongs to `World`, not to the algorithm.

    Args:
        config: Hyperparameters.
        seeds: One for each element of the batch ``S``.
        bank: Embedded demonstrations for training episodes.
        encoders: Trained encoders, or None if unused. The frame encoder is moved to the device.
        device: Device of the networks. Simulations, GWR-B and replay stay on the CPU.
        scene: The robot, or its name; NICO by default.

    Raises:
        ValueError: If policies are to read latents without encoders, or ground truth or joints of a
            scene that has none; or if actions of the demonstrations have another size than the
            robot's.

    Attributes:
        gwr: GWR-B, or None.
        groups: Groups of behaviors of each seed; empty for an algorithm without groups.
        conditioning: Transforms from the demonstration and task of an episode to what policies are
            conditioned on, such as ``context``: in training and in tests alike.
        beta: Weight of the intrinsic reward.
        state_size: Number of features of the state, with joints if policies read them.
        joints: Scale of the joints that policies read; None if they do not.
        learner: The RL algorithm: losses of actor and critic, optimizer, target networks.
        replay: Transitions of training episodes.
        proposals: Who plays an episode, the clone or what critics choose; None with one proposal.
        shown: Transitions of the demonstrations shown so far, or None without a
            ``demonstration_share``.
        test_actor: Network of test episodes, called with the parameters of a `Policy`.
        needs_label: Whether policies depend on the task label of a test episode.
        needs_replay: Whether `snapshot` depends on the replay buffer.
        takes_new_tasks: Whether a `state_dict` can be loaded into an algorithm that was made with
            further tasks, whose demonstrations come last in its bank.
        logged: Further entries of `update` to log, such as ``("loss_clone",)``: columns of
            ``train.csv``, 0 where an update has not returned them, and curves of dashboards.
    """

    gwr: GWRB | None = None
    groups: Sequence[BehaviorGroups] = ()
    conditioning: Sequence[Transform] = ()
    beta: float = 0.0
    needs_label: bool = True
    needs_replay: bool = True
    takes_new_tasks: bool = False
    logged: tuple[str, ...] = ()
    learner: Learner
    replay: GroupReplay
    shown: DemonstrationReplay | None = None
    test_actor: TensorDictModuleBase

    def __init__(
        self,
        config: AlgorithmConfig,
        *,
        seeds: Sequence[int],
        bank: DemonstrationBank,
        encoders: Representation | None = None,
        device: torch.device | str = "cpu",
        scene: Scene | str = "nico",
    ) -> None:
        self.config = config
        self.scene = find_scene(scene)
        self.device = torch.device(device)
        self.seeds = tuple(seeds)
        self.n_seeds, self.n_tasks = len(seeds), len(bank.tasks)
        self.bank, self.encoders = bank, encoders
        if encoders is not None:
            encoders.frame_network.to(self.device)
        self.state_size = observed_size(config, self.scene, encoders)
        self.joints = self.scene.joints if config.joints else None
        if bank.steps is not None and bank.steps.action.shape[-1] != self.scene.action_size:
            raise ValueError(
                f"actions of the demonstrations have {bank.steps.action.shape[-1]} components, "
                f"those of the scene {self.scene.name!r} have {self.scene.action_size}: use "
                "demonstrations of this robot"
            )
        self._noise = generators(seeds, "exploration")
        self.proposals: ProposalTrials | None = None
        if (rl := config.rl).proposals != "actor":
            self.logged = ("loss_clone", *self.logged)
        if rl.proposals == "both":
            self.proposals = ProposalTrials(
                len(seeds), clone_episodes=rl.clone_episodes, clone_share=rl.clone_share
            )

    def make_env(self, base_env: EnvBase, source: DemonstrationSource) -> TransformedEnv:
        """Return the environment of training episodes: simulations ``[S]`` within transforms.

        ``source`` is the transform that draws task and demonstration of each episode. BGPO has all
        parts; each ablation and baseline omits some.

        Raises:
            ValueError: If the intrinsic reward needs encoders and there are none.
        """
        config = self.config
        transforms: list[Transform] = [
            encode(config, self.encoders, self.scene.state),  # pixels -> latent
            StepCounter(
                config.max_steps, "truncated" if config.timeouts_bootstrap else "terminated"
            ),
            source,  # -> task, demo_embedding
            # -> behavior, group, expert, context
            *(transform.clone() for transform in self.conditioning),
        ]
        if self.beta:
            assert self.encoders is not None  # which latents need
            # reward + beta * exp(-||b - phi_g||)
            transforms.append(BehaviorMatchingReward(self.encoders.lae, self.beta))
        transforms += [*bound(config, self.joints), RewardSum()]  # episode_reward, ...
        return TransformedEnv(base_env, Compose(transforms))

    @torch.no_grad()
    def condition(self, index: int, embedding: Tensor, task: Tensor) -> TensorDictBase:
        """Return what the policy of one seed is conditioned on, ``[*B]``; learn nothing.

        This is ``demo_embedding``, ``task`` and the entries that `conditioning` writes. Arguments
        are those of `snapshot`.
        """
        shape = (self.n_seeds, *task.shape)
        shown = {"demo_embedding": embedding.expand(*shape, -1), "task": task.expand(shape)}
        conditioned: TensorDictBase = TensorDict(shown, shape)
        for transform in self.conditioning:
            conditioned = transform(conditioned)
        return conditioned[index]

    @abstractmethod
    def act(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the ``action`` ``[S, A]`` of the policy with exploration noise."""

    @abstractmethod
    def store(self, transition: TensorDictBase) -> None:
        """Add a transition of each seed, ``[S]``, to the replay buffer."""

    def store_logged(self, transition: TensorDictBase) -> None:
        """Store a transition that none of the policies has played: `store` without the counts."""
        proposals, self.proposals = self.proposals, None
        try:
            self.store(transition)
        finally:
            self.proposals = proposals

    def begin_task(self, index: int, task: int) -> None:  # noqa: B027 - most do not use it
        """Prepare for a further task of one seed; by default, do nothing.

        `Trainer` calls it between `store` and `act`, after the last episode in which the task could
        not be drawn. The tasks of the first episode do not begin in this sense. If several begin at
        once, they do so in the order of their numbers.

        To know when a task begins is to know more than the demonstrations show. Algorithms that
        define this method are reported as such, see `needs_boundaries`; BGPO does not.

        Args:
            index: Position of the seed in the batch.
            task: Number of the task, its label.
        """

    @property
    def needs_boundaries(self) -> bool:
        """Whether the algorithm is given the boundaries of tasks, by `begin_task`."""
        return type(self).begin_task is not Algorithm.begin_task

    @abstractmethod
    def update(self) -> dict[str, Tensor]:
        """Make one update of each seed from the transitions stored so far.

        It may run while the environment steps, so it uses neither the environment nor any state
        that `act` changes.

        Returns:
            ``loss_actor``, ``loss_value`` and other losses of each seed ``[S]`` (or ``[]``, of
            all), of which those in ``logged`` are logged too; empty before the first update.
        """

    @abstractmethod
    def snapshot(
        self, index: int, embedding: Tensor, task: Tensor, generator: torch.Generator
    ) -> Policy:
        """Copy the policy of one seed, conditioned on demonstrations, to the CPU; learn nothing.

        Args:
            index: Position of the seed in the batch.
            embedding: phi of the demonstration of each test episode, ``[*B, 32]``.
            task: Their labels, int64 ``[*B]``; ignored by BGPO.
            generator: Source of randomness for algorithms that adapt before testing.
        """

    def act_by(self, tensordict: TensorDictBase, groups: Sequence[int], expert: Tensor) -> Tensor:
        """Return actions of a training step ``[S, A]``, and choose who plays episodes that begin.

        Args:
            tensordict: Inputs of the policies, ``"step_count"`` and, with groups,
                ``"group_fits"``, ``[S]``.
            groups: Group or task of each seed's episode.
            expert: Place of its networks, int64 ``[S]``.
        """
        only_clone = None
        if self.proposals is not None:
            fits = tensordict.get("group_fits", None)
            for seed in (tensordict["step_count"].flatten() == 0).nonzero().flatten().tolist():
                trial = fits is not None and not fits[seed]
                self.proposals.begin(seed, groups[seed], trial=trial)
            only_clone = torch.tensor(self.proposals.only_clone)
        seen = self.to_device(tensordict.select(*self.learner.policy.in_keys))
        return self.learner.act(seen, self._noise, expert, only_clone)

    def count_episodes(self, transition: TensorDictBase, group: Tensor) -> None:
        """Count the successes of episodes that end, by who played them.

        Args:
            transition: Transitions ``[S]``.
            group: Group or task of each demonstration, int64 ``[S]``.
        """
        if self.proposals is None:
            return
        end = transition.get("next")
        for seed in end["done"].flatten().nonzero().flatten().tolist():
            self.proposals.end(
                seed,
                bool(end["success"][seed]),
                group=int(group[seed]),
                demonstration=int(transition["demo_index"][seed]),
            )

    def make_replay(
        self, constant_keys: Sequence[NestedKey] = (), source_key: NestedKey | None = None
    ) -> GroupReplay:
        """Return the replay of training episodes.

        Args:
            constant_keys: Policies' inputs that are constant in an episode.
            source_key: See `GroupReplay`.
        """
        rl, seen = self.config.rl, self.config.observed
        following = [("next", key) for key in (seen, "reward", "terminated", "done")]
        # A failure, such as a fall, terminates an episode too.
        success_key = ("next", "success") if rl.success_share else None
        return GroupReplay(
            rl.replay_size,
            generator=generators(self.seeds, "replay"),
            keys=[seen, *constant_keys, "action", *following],
            source_key=source_key,
            n_steps=rl.n_steps,
            gamma=rl.gamma,
            success_key=success_key,
        )

    def policy(
        self,
        parameters: dict[str, Tensor],
        context: Tensor | None = None,
        network: Tensor | None = None,
    ) -> Policy:
        """Return a policy of `test_actor`, given the attributes of `Policy`."""
        return Policy(self.test_actor, self.config.observed, parameters, context, network)

    def demonstrations(
        self, constant_keys: Sequence[NestedKey] = (), own_constants: bool = True
    ) -> DemonstrationReplay | None:
        """Return the replay of shown demonstrations, or None without a ``demonstration_share``.

        ``constant_keys`` are the policies' inputs that are constant within an episode;
        for these and ``own_constants``, see `DemonstrationReplay`.

        Raises:
            ValueError: If the state is not the latent, or the bank has no steps, or no joints that
                policies read.
        """
        if not self.config.demonstration_share:
            return None
        if self.config.state != "latent":
            raise ValueError("demonstrations are latents: choose an algorithm without them")
        return DemonstrationReplay(
            self.bank,
            generator=generators(self.seeds, "demonstration replay"),
            noise=self.config.demonstration_noise,
            pace=self.config.demonstration_pace,
            joints=self._demonstrated_joints(),
            limit=self.config.state_limit,
            constant_keys=constant_keys,
            own_constants=own_constants,
            n_steps=self.config.rl.n_steps,
            gamma=self.config.rl.gamma,
        )

    def _demonstrated_joints(self) -> Tensor | None:
        """Return the joints of the bank's steps as policies read them, ``[F, J]``, or None."""
        columns, steps = self.joints, self.bank.steps
        if columns is None or steps is None:
            return None
        if steps.joints is None or steps.joints.shape[1] != columns.size:
            found = "no joints" if steps.joints is None else f"{steps.joints.shape[1]} joints"
            raise ValueError(
                f"the bank has {found} of the demonstrations, policies are to read {columns.size}: "
                "record or write demonstrations with 'joints' and make the bank again (`bgpo "
                "bank`), or set joints to False"
            )
        # Scaled and bounded as in episodes; latents of none.
        frames = len(steps.joints)
        seen = TensorDict({"latent": torch.empty(frames, 0), "joints": steps.joints}, [frames])
        return Compose(bound(self.config, columns))(seen)[self.config.observed]

    def sample(
        self,
        groups: Callable[[int], Tensor],
        n_rows: int,
        *,
        share: float | None = None,
        generator: Sequence[torch.Generator] | None = None,
    ) -> TensorDictBase:
        """Draw transitions ``[S, E, B]`` to learn from, a share of demonstrated ones last.

        With a policy that imitates, ``"imitation"`` has as many demonstrated states and actions.

        Args:
            groups: Returns the group of each of ``n`` transitions, int64 ``[S, E, n]``, given
                ``n``; -1 for none.
            n_rows: Number of transitions ``B``.
            share: Share of demonstrated ones, by default ``demonstration_share``. With 1, none have
                to be in the replay of training episodes.
            generator: Random generators of the seeds, in place of the replays'.
        """
        if self.shown is None:
            return self.replay.sample(groups(n_rows), generator=generator)
        share = self.config.demonstration_share if share is None else share
        n_shown = round(share * n_rows)
        batch = shown = self.shown.draw(groups(n_shown), generator=generator)
        if n_shown < n_rows:
            played = self.replay.draw(groups(n_rows - n_shown), generator=generator)
            batch = {key: torch.cat([entry, shown[key]], 2) for key, entry in played.items()}
        if self.config.rl.imitates:
            imitated = self.shown.draw_actions(groups(n_rows), generator=generator)
            n_own = round(self.config.rl.success_share * n_rows)
            if n_own and n_shown < n_rows:
                self._imitate_successes(imitated, groups(n_own), generator)
            batch |= {("imitation", key): entry for key, entry in imitated.items()}
        return TensorDict(batch, batch["priority_weight"].shape)

    def _imitate_successes(
        self,
        imitated: dict[NestedKey, Tensor],
        group: Tensor,
        generator: Sequence[torch.Generator] | None,
    ) -> None:
        """Put own successes, with noise on their states, in place of the first of the rows.

        Rows stay as they are where a group ``[S, E, n]`` has no success.
        """
        assert self.shown is not None
        keys, n_rows = [*imitated.keys() - {"priority_weight"}], group.shape[-1]
        own = self.replay.draw(group, generator=generator, keys=keys, successes=True)
        own[self.config.observed] = self.shown.blur(own[self.config.observed], group, generator)
        known = own["priority_weight"] > 0
        for key in keys:
            entry = imitated[key][:, :, :n_rows]
            imitated[key][:, :, :n_rows] = torch.where(known.unsqueeze(-1), own[key], entry)

    def learn(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Take a gradient step on a batch and update the targets; return the losses of `update`."""
        return self.learner.learn(self.to_device(batch))

    def to_device(self, batch: TensorDictBase) -> TensorDictBase:
        """Return a batch on the device of the networks."""
        return batch if self.device == torch.device("cpu") else batch.to(self.device)

    def state_dict(self) -> dict[str, Any]:
        """Return everything that future actions, updates and snapshots depend on."""
        return {
            "noise": [generator.get_state() for generator in self._noise],
            **{name: dict(part.state_dict()) for name, part in self._learned().items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a `state_dict`."""
        for name, part in self._learned().items():
            part.load_state_dict(state[name])
        for generator, saved in zip(self._noise, state["noise"], strict=True):
            generator.set_state(saved)

    def _learned(self) -> dict[str, Any]:
        """Return the parts that learning changes."""
        parts = {
            name: getattr(self, name, None) for name in ("learner", "replay", "shown", "proposals")
        }
        return {name: part for name, part in parts.items() if part is not None}
