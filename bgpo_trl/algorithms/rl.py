"""The learner: networks of all seeds, exploration, and gradient steps of DDPG and of a clone.

An own RL algorithm f_RL is a `Learner` that an own `BGPO` makes, as
``examples/own_rl_algorithm.py`` does.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torch.func import functional_call

from bgpo_trl.configs import RLConfig
from bgpo_trl.modules.actor_critic import Actor, Critic, ProposalPolicy
from bgpo_trl.objectives.ddpg import DDPGLoss, ForeachSoftUpdate
from bgpo_trl.seeding import generators, normal

__all__ = ["Expert", "Learner", "LearnerSpec", "make_learner"]


Expert = dict[str, dict[str, Tensor]]
"""One expert of a learner, by name: ``networks`` with targets and averages, Adam's ``moments``."""


class Learner:
    """Policies of all seeds with their exploration and gradient steps.

    One Adam optimizer minimizes the sum of the losses. It treats each weight independently, so it
    is equivalent to one optimizer per seed.

    Args:
        policy: Writes the ``action`` without noise; its weights lead with ``[S, E]``.
        sources: Parameters in the loss, such as ``"actor_network_params"``, by the name of the
            submodule of ``policy`` that they belong to; by ``""`` for the policy itself.
        loss: Returns entries ``loss_...`` ``[S, E]`` to minimize (``reduction="none"``).
        config: Hyperparameters.
    """

    def __init__(
        self, policy: Any, sources: dict[str, str], loss: DDPGLoss, config: RLConfig
    ) -> None:
        loss.make_value_estimator(gamma=config.gamma)
        self.policy, self.loss, self.config, self.sources = policy, loss, config, sources
        self._prefixes = {f"{source}.": f"{at}." if at else "" for at, source in sources.items()}
        self.target_update = ForeachSoftUpdate(loss, tau=config.tau)
        learned = {name: p for name, p in loss.named_parameters() if p.requires_grad}
        self.optimizer = torch.optim.Adam(learned.values(), lr=config.learning_rate, fused=True)
        read = tuple(self._prefixes) if config.averaging else ()
        self._latest = {name: p for name, p in learned.items() if name.startswith(read)}
        self.average = {name: p.detach().clone() for name, p in self._latest.items()}
        self.n_averaged = loss.n_imitated.clone()

    @torch.no_grad()
    def act(
        self,
        tensordict: TensorDictBase,
        generators: Sequence[torch.Generator],
        expert: Tensor,
        only_clone: Tensor | None = None,
    ) -> Tensor:
        """Return actions of a training step, ``[S, A]`` in [-1, 1], on the CPU.

        Args:
            tensordict: Inputs of the policies, ``[S]``.
            generators: Generator of exploration noise of each seed.
            expert: Which expert of each seed acts, int64 ``[S]``.
            only_clone: Seeds in which the clone acts, bool ``[S]``; see `ProposalPolicy`.
        """
        seed = torch.arange(len(expert), device=tensordict.device)
        weights = self.policy_weights(seed, expert.to(seed.device), only_clone)
        inputs = tensordict.select(*self.policy.in_keys)
        action = functional_call(self.policy, weights, (inputs,), strict=True)["action"]
        return self.explore(action, generators)

    def explore(self, action: Tensor, generators: Sequence[torch.Generator]) -> Tensor:
        """Add Gaussian noise to actions ``[S, A]`` and clip them to [-1, 1]."""
        noise = self.config.noise * normal(generators, action.shape[1:])
        return (action.cpu() + noise).clamp(-1.0, 1.0)

    def policy_weights(
        self,
        seed: Tensor,
        expert: Tensor,
        only_clone: Tensor | None = None,
        *,
        averaged: bool = False,
    ) -> dict[str, Tensor]:
        """Copy the weights of the policies ``[*B]`` of experts, by name in `policy`.

        Args:
            seed: Position of the seed of each policy, int64 ``[*B]``.
            expert: Place of its expert in the stack, int64 ``[*B]``.
            only_clone: Whether its clone acts alone, bool ``[*B]``; by default not.
            averaged: Whether they are averaged, where they are, for tests (`RLConfig.averaging`).
        """
        networks = self._of_policy(self._stacked()["networks"], averaged=averaged)
        weights = {name: value[seed, expert] for name, value in networks.items()}
        return self._with_choice(weights, seed.shape, only_clone)

    def _of_policy(self, networks: dict[str, Tensor], *, averaged: bool) -> dict[str, Tensor]:
        """Return the tensors of the loss that the policy uses, by name in `policy`."""
        if averaged:
            networks = networks | {n: networks[f"average {n}"] for n in self.average}
        return {
            at + name.removeprefix(source): value
            for name, value in networks.items()
            for source, at in self._prefixes.items()
            if name.startswith(source)
        }

    def _with_choice(
        self, weights: dict[str, Tensor], shape: torch.Size, only_clone: Tensor | None
    ) -> dict[str, Tensor]:
        if isinstance(self.policy, ProposalPolicy):
            none = torch.zeros(shape, dtype=torch.bool)
            device = next(iter(weights.values())).device
            weights["only_clone"] = (none if only_clone is None else only_clone).to(device)
        return weights

    def learn(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Take a gradient step on transitions ``[S, E, B]``, update the targets; return the losses.

        Losses are sums over the experts of a seed, ``[S]``.
        """
        parts = self.losses(batch)
        self.optimizer.zero_grad()
        torch.stack([part.sum() for part in parts.values()]).sum().backward()
        self.optimizer.step()
        self.target_update.step()
        if self.average:
            self._average(batch)
        return {key: value.detach().sum(1) for key, value in parts.items()}

    @torch.no_grad()
    def _average(self, batch: TensorDictBase) -> None:
        """Let the averaged weights of the experts that have learned follow the latest ones.

        An update first has ten times its share of all so far, so that the average is of about the
        last tenth of them; later, it has the share ``averaging``.
        """
        learned = self.loss.trains(batch)
        self.n_averaged += learned
        share = (10.0 / self.n_averaged).clamp(self.config.averaging, 1.0) * learned
        for name, average in self.average.items():
            per_weight = share.reshape(*share.shape, *[1] * (average.ndim - 2))
            average.lerp_(self._latest[name], per_weight)

    def losses(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Return the losses ``[S, E]`` to minimize on transitions ``[S, E, B]``.

        That of the actor is due in one of ``policy_delay`` updates.

        Raises:
            RuntimeError: If the loss has not counted the update.
        """
        if self.config.proposals == "clone":
            return {"loss_clone": self.loss.loss_clone(batch)}
        n_calls = int(self.loss.n_calls)
        if (n_calls + 1) % self.config.policy_delay:
            clone = {"loss_clone": self.loss.loss_clone(batch)} if self.loss.has_clone else {}
            losses = {"loss_value": self.loss.loss_value(batch)[0], **clone}
        else:
            every = self.loss(batch).items()
            losses = {str(k): v for k, v in every if str(k).startswith("loss_")}
        if int(self.loss.n_calls) == n_calls:  # or the actor would never learn
            raise RuntimeError(
                f"{type(self.loss).__name__}.loss_value must call self.target once in an update, "
                "or add 1 to self.n_calls"
            )
        return losses

    def begin_anew(self, index: int) -> None:
        """Let the networks of one seed, given its position, begin another task.

        The actor imitates with the full weight again, and averages begin anew with the next update.
        The direction of the latest steps is forgotten, so that weights stay as they are without
        gradients. The second moments, by which Adam scales its steps, are kept.
        """
        for moments in self.optimizer.state.values():
            moments["exp_avg"][index] = 0.0
        self.loss.n_imitated[index] = 0
        self.n_averaged[index] = 0

    def _stacked(self) -> dict[str, dict[str, Tensor]]:
        """Return the tensors that have a row for each expert, ``[S, E, ...]``, as in `Expert`."""
        parameters = dict(self.loss.named_parameters())
        named, stack = {**parameters, **dict(self.loss.named_buffers())}, self.loss.batch_size
        if self.average:
            named |= {f"average {name}": value for name, value in self.average.items()}
            named["n_averaged"] = self.n_averaged
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
        return {
            part: {name: tensor[seed, slot].clone() for name, tensor in tensors.items()}
            for part, tensors in self._stacked().items()
        }

    @torch.no_grad()
    def write(self, seed: int, slot: int, expert: Expert) -> None:
        """Put an expert into a place of the stack; what it lacks is 0."""
        for part, tensors in self._stacked().items():
            for name, tensor in tensors.items():
                tensor[seed, slot] = expert[part].get(name, 0.0)

    @torch.no_grad()
    def resize(self, width: int) -> None:
        """Change the number ``E`` of experts, by leaving out the last or by copies of the first.

        Tensors keep their identity, so that optimizer, targets and policy follow. Copies have no
        moments.
        """
        now = self.loss.batch_size[1]
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
        self.loss.batch_size = torch.Size([self.loss.batch_size[0], width])

    def expert_weights(self, expert: Expert, only_clone: bool = False) -> dict[str, Tensor]:
        """Copy the weights of an expert's policy in tests to the CPU, by name in `policy`."""
        weights = self._of_policy(expert["networks"], averaged=True)
        copies = {name: value.to("cpu", copy=True) for name, value in weights.items()}
        return self._with_choice(copies, torch.Size(), torch.tensor(only_clone))

    def state_dict(self) -> dict[str, Any]:
        """Return the states of loss (with targets), optimizer and averaged weights."""
        return {
            "loss": dict(self.loss.state_dict()),
            "optimizer": self.optimizer.state_dict(),
            "average": {**self.average, "n_averaged": self.n_averaged},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a `state_dict`."""
        self.loss.load_state_dict(state["loss"])
        self.optimizer.load_state_dict(state["optimizer"])
        for name, value in {**self.average, "n_averaged": self.n_averaged}.items():
            value.copy_(state["average"][name])


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

    def actor(self, config: RLConfig, name: str = "actor") -> Actor:
        """Return policies ``[S, E]``, whose initial weights come from the stream ``name``."""
        return self.network(Actor, config, self._shape, self.generators(name))

    def critic(self, config: RLConfig) -> Critic:
        """Return Q-functions ``[S, E]``, or ``[S, E, N]`` if there are several critics."""
        shape = [*self._shape, config.critics] if config.critics > 1 else self._shape
        names = ["critic", *(f"critic {number} of" for number in range(1, config.critics))]
        each = zip(*(self.generators(name) for name in names), strict=True)
        norm, streams = config.critic_layer_norm, [stream for of in each for stream in of]
        return self.network(Critic, config, shape, streams, layer_norm=norm)

    def loss_options(self, config: RLConfig) -> dict[str, Any]:
        """Return the common arguments of the losses."""
        return {
            "n_critics": config.critics,
            "imitation": config.imitation,
            "imitation_half_life": config.imitation_half_life,
            "return_bounds": self.return_bounds if config.clip_targets else None,
            "pre_tanh_penalty": config.pre_tanh_penalty,
            "constant_keys": self.in_keys[1:],
            "reduction": "none",
        }

    @property
    def _shape(self) -> list[int]:
        return [len(self.seeds), len(self.experts)]

    def network(
        self,
        kind: Callable[..., Any],
        config: RLConfig,
        batch_size: Sequence[int],
        generator: torch.Generator | Sequence[torch.Generator] | None,
        **options: Any,
    ) -> Any:
        """Return a network of these inputs and actions, such as an `Actor`, on the device."""
        made = kind(
            self.in_features,
            self.action_size,
            in_keys=self.in_keys,
            hidden_sizes=config.hidden_sizes,
            batch_size=batch_size,
            generator=generator,
            **options,
        )
        return made.to(self.device)


def make_learner(config: RLConfig, spec: LearnerSpec) -> Learner:
    """Return the learner of a config: DDPG, a clone of demonstrations, or both."""
    actor, critic = spec.actor(config), spec.critic(config)
    clone = None if config.proposals == "actor" else spec.actor(config, "clone")
    loss = DDPGLoss(actor, critic, clone, **spec.loss_options(config))
    if clone is None:
        return Learner(actor, {"": "actor_network_params"}, loss, config)
    if config.proposals == "clone":
        return Learner(clone, {"": "clone_network_params"}, loss, config)
    sources = {
        "actor": "actor_network_params",
        "clone": "clone_network_params",
        "critic": "target_value_network_params",
    }
    return Learner(ProposalPolicy(actor, clone, critic, config.caution), sources, loss, config)
