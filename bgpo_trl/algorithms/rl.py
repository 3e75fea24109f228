"""The RL algorithm f_RL of Alg. 1: DDPG, TD3, SAC, and the place for one's own.

An own one is an entry of `RL` under the ``name`` of its config, such as the one that
``examples/own_rl_algorithm.py`` makes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule

from bgpo_trl.configs import DDPGConfig, RLConfig, SACConfig, TD3Config
from bgpo_trl.modules.actor_critic import Actor, Critic
from bgpo_trl.modules.gaussian_actor import GaussianActor
from bgpo_trl.objectives.ddpg import DDPGLoss
from bgpo_trl.objectives.off_policy import OffPolicyLoss
from bgpo_trl.objectives.sac import SACLoss
from bgpo_trl.objectives.target_update import ForeachSoftUpdate
from bgpo_trl.objectives.td3 import TD3Loss
from bgpo_trl.seeding import generators, normal

__all__ = ["RL", "Learner", "Problem", "RLEntry", "SACLearner", "TD3Learner", "make_learner"]


@dataclass(frozen=True)
class Problem:
    """What an RL algorithm is to learn: policies ``[S, E]``, one for each expert of each seed."""

    seeds: Sequence[int]
    """One for each element ``S`` of the batch."""
    in_keys: Sequence[NestedKey]
    """What the policy reads; all but the first are constant within an episode."""
    in_features: int
    """Size of all these together."""
    return_bounds: tuple[float, float]
    """Lowest and highest attainable return."""
    device: torch.device
    """Where networks and batches are."""
    experts: Sequence[int] = (0,)
    """Numbers of the experts ``E``; an expert's random numbers follow from its seed and number."""

    def generators(self, name: str) -> list[torch.Generator]:
        """Return one generator for each expert of each seed, for one purpose."""
        return [generators([s], f"{name} {e}")[0] for s in self.seeds for e in self.experts]

    def actor(self, network: Callable[..., Any], config: RLConfig) -> Any:
        """Return policies ``[S, E]`` of a class such as `Actor`."""
        return self._network(network, config, self._shape, self.generators("actor"))

    def critic(self, config: RLConfig) -> Critic:
        """Return Q-functions ``[S, E]``."""
        norm, streams = config.critic_layer_norm, self.generators("critic")
        return self._network(Critic, config, self._shape, streams, layer_norm=norm)

    def twin_critics(self, config: RLConfig) -> Critic:
        """Return Q-functions ``[S, E, 2]``."""
        first, second = (self.generators(name) for name in ("critic", "second critic"))
        norm, streams = config.critic_layer_norm, [*chain(*zip(first, second, strict=True))]
        return self._network(Critic, config, [*self._shape, 2], streams, layer_norm=norm)

    def loss_options(self, config: RLConfig) -> dict[str, Any]:
        """Return the arguments that the losses of this package have in common."""
        return {
            "return_bounds": self.return_bounds if config.clip_targets else None,
            "constant_keys": self.in_keys[1:],
        }

    @property
    def _shape(self) -> list[int]:
        return [len(self.seeds), len(self.experts)]

    def _network(
        self,
        network: Callable[..., Any],
        config: RLConfig,
        batch_size: Sequence[int],
        generator: Sequence[torch.Generator],
        **options: Any,
    ) -> Any:
        made = network(
            self.in_features,
            in_keys=self.in_keys,
            hidden_sizes=config.hidden_sizes,
            batch_size=batch_size,
            generator=generator,
            **options,
        )
        return made.to(self.device)


class Learner:
    """The policies of all seeds and how they improve: as they are, DDPG's.

    Its optimizer is Adam on the sum of the loss's parts. Adam treats each weight by itself, so one
    for all networks is one for each.

    Args:
        actor: Called with what it reads, writes the ``action`` without noise. Its weights lead with
            ``[S]``.
        loss: Reads transitions ``[S, B]`` and returns, among others, entries ``loss_...`` ``[]`` to
            be minimized, each a sum over the seeds. It has target networks.
        config: Its ``gamma``, ``tau`` and ``learning_rate`` are used here.
        noise: Standard deviation of the Gaussian exploration noise.

    Attributes:
        config: The hyperparameters.
        optimizer: Of all that the loss is to learn.
        target_update: Of the target networks.
    """

    def __init__(
        self, actor: Any, loss: LossModule, config: RLConfig, *, noise: float = 0.0
    ) -> None:
        loss.make_value_estimator(gamma=config.gamma)
        self.actor, self.loss, self.config, self.noise = actor, loss, config, noise
        self.target_update = ForeachSoftUpdate(loss, tau=config.tau)
        learned = [p for p in loss.parameters() if p.requires_grad]
        self.optimizer = torch.optim.Adam(learned, lr=config.learning_rate, fused=True)

    def act(
        self, tensordict: TensorDictBase, generators: Sequence[torch.Generator], expert: Tensor
    ) -> Tensor:
        """Return actions of a training step, ``[S, 4]`` in [-1, 1], on the CPU.

        Args:
            tensordict: What the policies read, ``[S]``.
            generators: Sources of exploration, one for each seed.
            expert: Which expert of each seed acts, int64 ``[S]``.
        """
        action = self.actor(self._for_all(tensordict))["action"]
        return self.explore(_of_expert(action, expert), generators)

    def _for_all(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return what is read ``[S]`` by all experts, ``[S, E]``."""
        return tensordict.unsqueeze(1).expand(*self.actor.batch_size)

    def explore(self, action: Tensor, generators: Sequence[torch.Generator]) -> Tensor:
        """Return actions ``[S, 4]`` with each seed's Gaussian noise, within [-1, 1]."""
        noise = self.noise * normal(generators, action.shape[1:])
        return (action.cpu() + noise).clamp(-1.0, 1.0)

    def learn(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Take a gradient step on transitions ``[S, E, B]``, and one of the target networks.

        Returns:
            The parts of the loss that the step minimized, sums over seeds and experts ``[]``.
        """
        parts = self.losses(batch)
        self.optimizer.zero_grad()
        torch.stack([*parts.values()]).sum().backward()
        self.optimizer.step()
        if self.actor_is_due:
            self.target_update.step()
        return {key: value.detach() for key, value in parts.items()}

    def losses(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Return the parts of the loss to be minimized on transitions ``[S, E, B]``."""
        return {str(k): v for k, v in self.loss(batch).items() if str(k).startswith("loss_")}

    @property
    def actor_is_due(self) -> bool:
        """Whether the next update is one of the actor and the target networks, too."""
        return True

    def state_dict(self) -> dict[str, Any]:
        """Return all that future updates depend on."""
        return {"loss": dict(self.loss.state_dict()), "optimizer": self.optimizer.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from what `state_dict` returned."""
        self.loss.load_state_dict(state["loss"])
        self.optimizer.load_state_dict(state["optimizer"])


class TD3Learner(Learner):
    """Updates actor and target networks less often than the critics (Fujimoto et al., 2018).

    Args:
        actor: As in `Learner`.
        loss: As in `Learner`; ``loss_actor`` is the part that waits.
        config: Hyperparameters.

    Raises:
        ValueError: If ``policy_delay`` is less than 1.
    """

    loss: OffPolicyLoss

    def __init__(self, actor: Any, loss: OffPolicyLoss, config: TD3Config) -> None:
        if config.policy_delay < 1:
            raise ValueError(f"policy_delay must be at least 1, got {config.policy_delay}")
        super().__init__(actor, loss, config, noise=config.noise)
        self.policy_delay, self.n_updates = config.policy_delay, 0
        self.loss_actor = torch.zeros(())

    def learn(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Take a gradient step on transitions ``[S, E, B]``; see `Learner.learn`.

        Returns:
            The parts of the loss; ``loss_actor`` is that of the actor's latest update, or 0.
        """
        parts = super().learn(batch)
        self.n_updates += 1
        self.loss_actor = parts.get("loss_actor", self.loss_actor)
        return {"loss_actor": self.loss_actor, **parts}

    def losses(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Return the parts of the loss; without the actor's, where it waits."""
        if self.actor_is_due:
            return super().losses(batch)
        return {"loss_value": self.loss.loss_value(batch)[0]}

    @property
    def actor_is_due(self) -> bool:
        """Whether the next update is the last of ``policy_delay``."""
        return (self.n_updates + 1) % self.policy_delay == 0

    def state_dict(self) -> dict[str, Any]:
        """Return all that future updates depend on."""
        latest = {"n_updates": self.n_updates, "loss_actor": self.loss_actor}
        return {**super().state_dict(), **latest}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from what `state_dict` returned."""
        super().load_state_dict(state)
        self.n_updates, self.loss_actor = state["n_updates"], state["loss_actor"]


class SACLearner(Learner):
    """Explores by what its stochastic policy draws (Haarnoja et al., 2018)."""

    actor: GaussianActor

    def act(
        self, tensordict: TensorDictBase, generators: Sequence[torch.Generator], expert: Tensor
    ) -> Tensor:
        """Return actions drawn for a training step; see `Learner.act`."""
        noise = normal(generators, [self.actor.action_dim]).unsqueeze(1)
        noise = noise.expand(*self.actor.batch_size, -1)
        device = next(self.actor.parameters()).device
        drawn = self.actor.sample(self._for_all(tensordict), noise.to(device))
        return _of_expert(drawn["action"], expert).cpu()


def _of_expert(values: Tensor, expert: Tensor) -> Tensor:
    """Return those of one expert of each seed, ``[S, ...]`` of ``[S, E, ...]``."""
    seed = torch.arange(len(values), device=values.device)
    return values[seed, expert.to(values.device)]


def make_ddpg(config: DDPGConfig, problem: Problem) -> Learner:
    """Return DDPG (Lillicrap et al., 2016), the paper's."""
    actor = problem.actor(Actor, config)
    loss = DDPGLoss(
        actor,
        problem.critic(config),
        pre_tanh_penalty=config.pre_tanh_penalty,
        **problem.loss_options(config),
    )
    return Learner(actor, loss, config, noise=config.noise)


def make_td3(config: TD3Config, problem: Problem) -> Learner:
    """Return TD3 (Fujimoto et al., 2018)."""
    actor = problem.actor(Actor, config)
    loss = TD3Loss(
        actor,
        problem.twin_critics(config),
        policy_noise=config.policy_noise,
        noise_clip=config.noise_clip,
        pre_tanh_penalty=config.pre_tanh_penalty,
        generator=problem.generators("target noise"),
        **problem.loss_options(config),
    )
    return TD3Learner(actor, loss, config)


def make_sac(config: SACConfig, problem: Problem) -> Learner:
    """Return SAC with a learned temperature (Haarnoja et al., 2018)."""
    actor = problem.actor(GaussianActor, config)
    loss = SACLoss(
        actor,
        problem.twin_critics(config),
        alpha_init=config.alpha_init,
        target_entropy=config.target_entropy,
        entropy_in_target=config.entropy_in_target,
        generator=problem.generators("policy samples"),
        **problem.loss_options(config),
    )
    return SACLearner(actor, loss, config)


@dataclass(frozen=True)
class RLEntry:
    """How to make an RL algorithm."""

    make: Callable[[Any, Problem], Learner]
    """Called with a config and the problem."""
    config: RLConfig
    """Its default hyperparameters; those of a run are of the same class."""


RL: dict[str, RLEntry] = {
    "ddpg": RLEntry(make_ddpg, DDPGConfig()),
    "td3": RLEntry(make_td3, TD3Config()),
    "sac": RLEntry(make_sac, SACConfig()),
}
"""RL algorithms by the ``name`` of their config."""


def make_learner(config: RLConfig, problem: Problem) -> Learner:
    """Return the RL algorithm that a config is of.

    Raises:
        ValueError: If `RL` has none under its name.
    """
    entry = RL.get(config.name)
    if entry is None or not isinstance(config, type(entry.config)):
        raise ValueError(
            f"{type(config).__name__} is of no known RL algorithm (its name is {config.name!r}): "
            "add it to bgpo_trl.algorithms.rl.RL under that name"
        )
    return entry.make(config, problem)
