"""The RL algorithm f_RL of Alg. 1: exploration and gradient steps, by default of DDPG.

Another one is added as an entry of `RL` under the ``name`` of its config, as
``examples/own_rl_algorithm.py`` does.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from bgpo_trl.algorithms.compilation import CompiledGradients
from bgpo_trl.configs import DDPGConfig, RLConfig
from bgpo_trl.modules.actor_critic import Actor, Critic
from bgpo_trl.objectives.ddpg import DDPGLoss
from bgpo_trl.objectives.off_policy import ForeachSoftUpdate, OffPolicyLoss
from bgpo_trl.seeding import generators, normal

__all__ = ["RL", "Expert", "Learner", "LearnerSpec", "RLEntry", "make_learner"]


Expert = dict[str, dict[str, Tensor]]
"""One expert of a learner: ``networks`` with targets, ``moments`` of Adam, state of its ``noise``,
each by name."""


class Learner:
    """Policies of all seeds with the exploration and gradient steps of DDPG.

    One Adam optimizer minimizes the sum of the losses. It treats each weight independently, so it
    is equivalent to one optimizer per seed.

    Args:
        actor: Writes the ``action`` without noise; its weights lead with ``[S, E]``.
        loss: Returns entries ``loss_...`` ``[S, E]`` to minimize (``reduction="none"``).
        config: Hyperparameters, of which ``gamma``, ``tau``, ``learning_rate`` and DDPG's
            ``compile`` are read here.
        noise: Standard deviation of the Gaussian exploration noise.
    """

    def __init__(
        self, actor: Any, loss: OffPolicyLoss, config: RLConfig, *, noise: float = 0.0
    ) -> None:
        loss.make_value_estimator(gamma=config.gamma)
        self.actor, self.loss, self.config, self.noise = actor, loss, config, noise
        self.target_update = ForeachSoftUpdate(loss, tau=config.tau)
        learned = [p for p in loss.parameters() if p.requires_grad]
        self.optimizer = torch.optim.Adam(learned, lr=config.learning_rate, fused=True)
        compiles = isinstance(config, DDPGConfig) and config.compile
        self.compute_gradients = (
            CompiledGradients(self.losses, learned) if compiles else self._compute_gradients
        )

    def act(
        self, tensordict: TensorDictBase, generators: Sequence[torch.Generator], expert: Tensor
    ) -> Tensor:
        """Return actions of a training step, ``[S, A]`` in [-1, 1], on the CPU.

        The policies' inputs are ``[S]``, with one generator of exploration noise per seed;
        ``expert`` ``[S]`` selects the expert that acts.
        """
        action = self.actor(self._for_all(tensordict))["action"]
        return self.explore(of_expert(action, expert), generators)

    def _for_all(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Expand inputs ``[S]`` to all experts, ``[S, E]``."""
        return tensordict.unsqueeze(1).expand(*self.actor.batch_size)

    def explore(self, action: Tensor, generators: Sequence[torch.Generator]) -> Tensor:
        """Add Gaussian noise to actions ``[S, A]`` and clip them to [-1, 1]."""
        noise = self.noise * normal(generators, action.shape[1:])
        return (action.cpu() + noise).clamp(-1.0, 1.0)

    def learn(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Take a gradient step on transitions ``[S, E, B]``, update the targets; return the losses.

        Losses are sums over the experts of a seed, ``[S]``.
        """
        parts = self.compute_gradients(batch)
        self.optimizer.step()
        if self.actor_is_due:
            self.target_update.step()
        return {key: value.sum(1) for key, value in parts.items()}

    def _compute_gradients(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Set the gradients of the parameters and return the losses ``[S, E]``, detached."""
        parts = self.losses(batch)
        self.optimizer.zero_grad()
        torch.stack([part.sum() for part in parts.values()]).sum().backward()
        return {key: value.detach() for key, value in parts.items()}

    def losses(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Return the losses ``[S, E]`` to minimize on transitions ``[S, E, B]``."""
        return {str(k): v for k, v in self.loss(batch).items() if str(k).startswith("loss_")}

    def clear_momentum(self, index: int) -> None:
        """Forget the direction of the latest steps of one seed, given its position.

        Without gradients, its weights then stay as they are. The second moments, by which Adam
        scales its steps, are kept.
        """
        for moments in self.optimizer.state.values():
            moments["exp_avg"][index] = 0.0

    def _stacked(self) -> dict[str, dict[str, Tensor]]:
        """Return the tensors that have a row for each expert, ``[S, E, ...]``, as in `Expert`."""
        parameters = dict(self.loss.named_parameters())
        named, stack = {**parameters, **dict(self.loss.named_buffers())}, self.actor.batch_size
        return {
            "networks": {k: v for k, v in named.items() if v.shape[: len(stack)] == stack},
            "moments": {
                f"{moment} of {name}": value
                for name, parameter in parameters.items()
                for moment, value in self.optimizer.state.get(parameter, {}).items()
                if moment != "step"
            },
        }

    @torch.no_grad()
    def read(self, seed: int, slot: int) -> Expert:
        """Copy an expert, given its place in the stack."""
        expert = {
            part: {name: tensor[seed, slot].clone() for name, tensor in tensors.items()}
            for part, tensors in self._stacked().items()
        }
        noise = self.loss.noise
        return {**expert, "noise": {} if noise is None else {"state": noise.get(seed, slot)}}

    @torch.no_grad()
    def write(self, seed: int, slot: int, expert: Expert) -> None:
        """Put an expert into a place of the stack; moments that it lacks are 0."""
        for part, tensors in self._stacked().items():
            for name, tensor in tensors.items():
                tensor[seed, slot] = expert[part].get(name, 0.0)
        if self.loss.noise is not None:
            self.loss.noise.set(seed, slot, expert["noise"]["state"])

    @torch.no_grad()
    def resize(self, width: int) -> None:
        """Change the number ``E`` of experts, by leaving out the last or by copies of the first.

        Tensors keep their identity, so that optimizer, targets and policy follow. Copies have no
        moments.
        """
        now = self.actor.batch_size[1]
        if width == now:
            return
        self.optimizer.zero_grad()
        columns = [slot if slot < now else 0 for slot in range(width)]
        for part, tensors in self._stacked().items():
            for tensor in tensors.values():
                resized = tensor[:, columns]
                if part == "moments":
                    resized[:, now:] = 0.0
                tensor.data = resized
        self.loss.batch_size = self.actor.batch_size
        if self.loss.noise is not None:
            self.loss.noise.resize(width)

    def actor_weights(self, expert: Expert) -> dict[str, Tensor]:
        """Copy the weights of an expert's policy to the CPU, by name in the actor."""
        networks = expert["networks"]
        return {
            name: networks[f"actor_network_params.{name}"].to("cpu", copy=True)
            for name, _ in self.actor.named_parameters()
        }

    @property
    def actor_is_due(self) -> bool:
        """Whether the next update also updates the actor and the target networks."""
        return True

    def state_dict(self) -> dict[str, Any]:
        """Return the states of loss (with targets) and optimizer."""
        return {"loss": dict(self.loss.state_dict()), "optimizer": self.optimizer.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a `state_dict`."""
        self.loss.load_state_dict(state["loss"])
        self.optimizer.load_state_dict(state["optimizer"])


def of_expert(values: Tensor, expert: Tensor) -> Tensor:
    """Select one expert of each seed from ``[S, E, ...]``."""
    seed = torch.arange(len(values), device=values.device)
    return values[seed, expert.to(values.device)]


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


@dataclass(frozen=True)
class RLEntry:
    """RL algorithm and its default hyperparameters."""

    make: Callable[[Any, LearnerSpec], Learner]
    """Called with a config and the spec."""
    config: RLConfig
    """Its default hyperparameters; those of a run are of the same class."""


RL: dict[str, RLEntry] = {"ddpg": RLEntry(make_ddpg, DDPGConfig())}
"""RL algorithms by the ``name`` of their config; `bgpo_trl.algorithms.twin_critics` adds TD3 and
SAC."""


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
