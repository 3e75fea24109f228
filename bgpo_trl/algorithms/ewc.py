"""Baselines of continual learning that are given boundaries: fine-tuning, without and with EWC."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.func import functional_call

from bgpo_trl.algorithms.bgpo import BGPO
from bgpo_trl.algorithms.rl import Learner, LearnerSpec
from bgpo_trl.configs import EWCConfig, FineTuningConfig
from bgpo_trl.seeding import generators


class FineTuning(BGPO):
    """One policy that goes on learning where a task begins, from an empty replay.

    It is given the boundaries of tasks, and by default no context: a lower bound for methods
    against forgetting (Wolczyk et al., 2021, "Continual World"). It is meant for the sequential
    schedule, in which only the newest task is played. ``ddpg`` in that schedule differs in that it
    still learns from the transitions of earlier tasks. With a ``demonstration_share``, it also
    learns from demonstrations, of those shown since the boundary: after it, the clone plays the
    first episodes and the actor imitates as in a new expert of BGPO.

    After a boundary, a seed rests until its replay holds ``warmup_steps`` transitions again, as
    before its first update: it acts, and its actor and critic do not change.
    """

    config: FineTuningConfig
    _n_steps = 0

    def store(self, transition: TensorDictBase) -> None:
        """Store a transition of each seed."""
        super().store(transition)
        self._n_steps += 1

    def update(self) -> dict[str, Tensor]:
        """Make one update of each seed whose replay holds ``warmup_steps`` transitions."""
        rl = self.config.rl
        # All seeds share the optimizer's count of updates, so these begin by the number of steps.
        if self._n_steps < rl.warmup_steps:
            return {}
        group = torch.where(self.n_held() >= rl.warmup_steps, 0, -1).view(-1, 1, 1)
        return self.learn(self.sample(lambda n: group.expand(-1, -1, n), rl.batch_size))

    def n_held(self) -> Tensor:
        """Return the number of transitions in the replay of each seed, int64 ``[S]``."""
        return self.replay.sizes(torch.zeros(self.n_seeds, 1, dtype=torch.int64)).flatten()

    def begin_task(self, index: int, task: int) -> None:
        """Empty the replay of the seed, which then rests until it has filled again."""
        del task
        self.replay.clear(index)
        if self.shown is not None:
            self.shown.clear(index)
        if self.proposals is not None:
            self.proposals.follow(index, [], [])  # what it counted was of the task that ends
        self.learner.begin_anew(index)

    def state_dict(self) -> dict[str, Any]:
        """Return everything that future actions, updates and snapshots depend on."""
        return {**super().state_dict(), "n_steps": self._n_steps}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a `state_dict`."""
        super().load_state_dict(state)
        self._n_steps = state["n_steps"]


_CHUNK = 64  # samples whose gradients are held at once


class EWC(FineTuning):
    """Fine-tuning with elastic weight consolidation (EWC; Kirkpatrick et al., 2017).

    When a task begins, it estimates how much the actions of the seed depend on each weight of its
    actor and, with demonstrations, of its clone (`diagonal_fisher`), from transitions of the task
    that ends, and adds this to the estimates of earlier boundaries. From then on, `EWCLearner`
    keeps both near their present weights. This is the online form (Schwarz et al., 2018), with one
    penalty for all earlier tasks; estimates do not decay. As by default in Continual World (Wolczyk
    et al., 2021), critics are free to change and the replay is emptied.

    Arguments as for `BGPO`.
    """

    config: EWCConfig
    learner: EWCLearner

    def make_learner(self, spec: LearnerSpec) -> Learner:
        """Return a learner with the penalty of EWC."""
        return EWCLearner(super().make_learner(spec), weight=self.config.ewc_weight)

    def begin_task(self, index: int, task: int) -> None:
        """Consolidate the policies of the seed in the task that ends, and empty its replay.

        If the replay is empty already, since several tasks begin at once, nothing changes.
        """
        if self.n_held()[index]:
            stream = generators([self.seeds[index]], f"fisher {task}")
            rows = torch.zeros(1, self.config.fisher_samples, dtype=torch.int64)
            drawn = self.replay.sample(rows, seeds=[index], generator=stream)
            self.learner.consolidate(index, self.to_device(drawn.select(*self.in_keys).squeeze(0)))
        super().begin_task(index, task)


class EWCLearner(Learner):
    """DDPG learner with the penalty of EWC on actor and clone (Kirkpatrick et al., 2017, Eq. 3).

    For each seed, it is ``weight / 2`` times the sum over the weights of actor and clone of the
    Fisher information times the squared distance from the anchor, the weights at the latest
    boundary. It is 0 before the first one.

    Args:
        learner: Learner without the penalty, whose networks it trains.
        weight: Weight lambda of the penalty.

    Attributes:
        anchor: Weights of actors and clones at the latest boundary of each seed, by name in
            ``loss``, ``[S, E, ...]``.
        fisher: Diagonal of the Fisher information, summed over boundaries, in the same form.
    """

    def __init__(self, learner: Learner, *, weight: float) -> None:
        super().__init__(learner.policy, learner.sources, learner.loss, learner.config)
        self.weight = weight
        self.anchor = {key: value.detach().clone() for key, value in self._weights().items()}
        self.fisher = {key: torch.zeros_like(value) for key, value in self.anchor.items()}

    def losses(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Return the losses of DDPG, and the penalty of the policies that learn, ``[S, E]``."""
        losses = super().losses(batch)
        learning = [p for p in self._policies if f"loss_{p.removesuffix('_network')}" in losses]
        return {**losses, "loss_ewc": self.penalty(learning)} if learning else losses

    def penalty(self, policies: Sequence[str] | None = None) -> Tensor:
        """Return the penalty of each expert, ``[S, E]``.

        Args:
            policies: Networks of ``loss`` whose weights count; None: actor and clone.
        """
        of_each = [
            (self.fisher[key] * (value - self.anchor[key]).square()).flatten(2).sum(-1)
            for key, value in self._weights(policies).items()
        ]
        return self.weight / 2 * torch.stack(of_each).sum(0)

    def consolidate(self, index: int, inputs: TensorDictBase) -> None:
        """Anchor actor and clone of one seed where they are.

        Args:
            index: Position of the seed.
            inputs: Their inputs ``[N]`` in states of the task that ends.
        """
        for policy in self._policies:
            params = getattr(self.loss, f"{policy}_params").flatten_keys(".").items()
            weights = {str(key): value[index, 0].detach() for key, value in params}
            fisher = diagonal_fisher(getattr(self.loss, policy), weights, inputs)
            for key, value in fisher.items():
                self.anchor[f"{policy}_params.{key}"][index, 0] = weights[key]
                self.fisher[f"{policy}_params.{key}"][index, 0] += value

    @property
    def _policies(self) -> tuple[str, ...]:
        return ("actor_network", *(["clone_network"] if self.loss.has_clone else []))

    def _weights(self, policies: Sequence[str] | None = None) -> dict[str, Tensor]:
        of_policies = tuple(f"{policy}_params." for policy in policies or self._policies)
        named = self.loss.named_parameters()
        return {name: value for name, value in named if name.startswith(of_policies)}

    def state_dict(self) -> dict[str, Any]:
        """Return the states of loss and optimizer, and what the penalty depends on."""
        return {**super().state_dict(), "anchor": {**self.anchor}, "fisher": {**self.fisher}}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a `state_dict`."""
        super().load_state_dict(state)
        for name in ("anchor", "fisher"):
            for key, value in getattr(self, name).items():
                value.copy_(state[name][key])


def diagonal_fisher(
    actor: TensorDictModuleBase, weights: dict[str, Tensor], inputs: TensorDictBase
) -> dict[str, Tensor]:
    """Return the diagonal of the Fisher information of a deterministic policy, by weight.

    The policy is taken as the mean of a Gaussian of unit variance, whose Fisher information is the
    mean over the states of the squared gradients of the action's components, summed over these
    (the Gauss-Newton form). Another variance would be another factor of the penalty.

    Args:
        actor: Writes the ``action``; stacked networks of any batch size.
        weights: Weights of one policy, by name in the actor.
        inputs: Its inputs ``[N]``.
    """
    fisher = {key: torch.zeros_like(value) for key, value in weights.items()}
    for chunk in inputs.split(_CHUNK):
        # One copy of the network per sample, so that a sum has the gradients of each sample.
        copies = {
            key: value.expand(len(chunk), *value.shape).clone().requires_grad_()
            for key, value in weights.items()
        }
        action = functional_call(actor, copies, (chunk.clone(),))["action"]
        for component in action.unbind(-1):
            gradients = torch.autograd.grad(component.sum(), [*copies.values()], retain_graph=True)
            for key, gradient in zip(fisher, gradients, strict=True):
                fisher[key] += gradient.square().sum(0)
    return {key: value / len(inputs) for key, value in fisher.items()}
