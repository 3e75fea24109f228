"""The RL algorithm f_RL of Alg. 1: DDPG, TD3 or SAC.

Another one is added as an entry of `RL` under the ``name`` of its config, as
``examples/own_rl_algorithm.py`` does.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import torch
from tensordict import NestedKey

from bgpo_trl.algorithms.learner import Learner, SACLearner, TD3Learner
from bgpo_trl.configs import DDPGConfig, RLConfig, SACConfig, TD3Config
from bgpo_trl.modules.actor_critic import Actor, Critic
from bgpo_trl.modules.gaussian_actor import GaussianActor
from bgpo_trl.objectives.ddpg import DDPGLoss
from bgpo_trl.objectives.sac import SACLoss
from bgpo_trl.objectives.td3 import TD3Loss
from bgpo_trl.seeding import generators

__all__ = ["RL", "LearnerSpec", "RLEntry", "make_learner"]


@dataclass(frozen=True)
class LearnerSpec:
    """Shapes and inputs of a learner of policies ``[S, E]``, one per expert of each seed."""

    seeds: Sequence[int]
    """One per element ``S`` of the batch."""
    in_keys: Sequence[NestedKey]
    """Entries that the policy reads; all but the first are constant within an episode."""
    in_features: int
    """Total size of these entries."""
    return_bounds: tuple[float, float]
    """Lowest and highest attainable return."""
    device: torch.device
    """Device of networks and batches."""
    experts: Sequence[int] = (0,)
    """Numbers of the experts ``E``. Seed and number determine an expert's initial weights."""
    action_size: int = 4
    """Number of components of an action."""

    def generators(self, name: str) -> list[torch.Generator]:
        """Return one generator per expert of each seed, for one purpose."""
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
        """Return the common arguments of the losses."""
        return {
            "return_bounds": self.return_bounds if config.clip_targets else None,
            "imitation": config.imitation,
            "constant_keys": self.in_keys[1:],
            "reduction": "none",
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
            self.action_size,
            in_keys=self.in_keys,
            hidden_sizes=config.hidden_sizes,
            batch_size=batch_size,
            generator=generator,
            **options,
        )
        return made.to(self.device)


def make_ddpg(config: DDPGConfig, spec: LearnerSpec) -> Learner:
    """Return a DDPG learner (Lillicrap et al., 2016)."""
    actor = spec.actor(Actor, config)
    loss = DDPGLoss(
        actor,
        spec.critic(config),
        pre_tanh_penalty=config.pre_tanh_penalty,
        **spec.loss_options(config),
    )
    return Learner(actor, loss, config, noise=config.noise)


def make_td3(config: TD3Config, spec: LearnerSpec) -> Learner:
    """Return a TD3 learner (Fujimoto et al., 2018)."""
    actor = spec.actor(Actor, config)
    loss = TD3Loss(
        actor,
        spec.twin_critics(config),
        policy_noise=config.policy_noise,
        noise_clip=config.noise_clip,
        pre_tanh_penalty=config.pre_tanh_penalty,
        generator=spec.generators("target noise"),
        **spec.loss_options(config),
    )
    return TD3Learner(actor, loss, config)


def make_sac(config: SACConfig, spec: LearnerSpec) -> Learner:
    """Return a SAC learner with a learned temperature (Haarnoja et al., 2018)."""
    actor = spec.actor(GaussianActor, config)
    loss = SACLoss(
        actor,
        spec.twin_critics(config),
        alpha_init=config.alpha_init,
        target_entropy=config.target_entropy * spec.action_size,
        entropy_in_target=config.entropy_in_target,
        generator=spec.generators("policy samples"),
        **spec.loss_options(config),
    )
    return SACLearner(actor, loss, config)


@dataclass(frozen=True)
class RLEntry:
    """RL algorithm and its default hyperparameters."""

    make: Callable[[Any, LearnerSpec], Learner]
    """Called with a config and the spec."""
    config: RLConfig
    """Its default hyperparameters; those of a run are of the same class."""


RL: dict[str, RLEntry] = {
    "ddpg": RLEntry(make_ddpg, DDPGConfig()),
    "td3": RLEntry(make_td3, TD3Config()),
    "sac": RLEntry(make_sac, SACConfig()),
}
"""RL algorithms by the ``name`` of their config."""


def make_learner(config: RLConfig, spec: LearnerSpec) -> Learner:
    """Return the learner of a config.

    Raises:
        ValueError: If `RL` has none under its name.
    """
    entry = RL.get(config.name)
    if entry is None or not isinstance(config, type(entry.config)):
        raise ValueError(
            f"{type(config).__name__} is of no known RL algorithm (its name is {config.name!r}): "
            "add it to bgpo_trl.algorithms.rl.RL under that name"
        )
    return entry.make(config, spec)
