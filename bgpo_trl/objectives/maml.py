"""MAML over DDPG: a policy that solves each task after one gradient step on that task's critic."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.func import functional_call, grad

from bgpo_trl.configs import MAMLConfig
from bgpo_trl.objectives.ddpg import DDPGLoss

Parameters = dict[str, Tensor]


class MAMLLoss(DDPGLoss):
    """Loss of a policy after its adaptation to each task (Finn et al., 2017, Alg. 3).

    With ``L_i(theta) = -mean Q_i(s, pi_theta(s))``, the actor's loss in `DDPGLoss` (with its
    penalty and the distance to the task's demonstrated actions) for the critics of task i, it

    1. adapts the policy to each task, ``theta_i = theta - inner_learning_rate * grad L_i(theta)``,
       on the first half of the task's transitions;
    2. evaluates the adapted policies by ``sum_i L_i(theta_i)`` on the second halves; the gradient
       with respect to ``theta`` goes through step 1, second derivatives included;
    3. trains each task's critic on all its transitions as `DDPGLoss` does. Target actions are those
       of a slow copy of the adapted policy, since that policy's value is to be learned.

    ``theta`` are the parameters of ``meta_network``. Those in ``actor_network_params`` are the
    latest ``theta_i``, written here, without gradient; the target networks follow them. They must
    be updated by `ForeachSoftUpdate`, since TorchRL's `SoftUpdate` skips parameters without
    gradient.

    Reads what `DDPGLoss` reads, with batch size ``[*S, T, B]``, ``B`` even, and
    ``"priority_weight"`` ``[*S, T, B]``, 0 for tasks without data. Returns what `DDPGLoss` returns,
    per task.

    Args:
        meta_network: Policy with ``batch_size`` ``[*S]``.
        actor_network: The same policy with ``batch_size`` ``[*S, T]``. It stays as it is; a copy of
            it, with the parameters ``actor_network_params``, holds the adapted policies.
        value_network: Q-functions with ``batch_size`` ``[*S, T]``, or ``[*S, T, N]``.
        inner_learning_rate: Step size of the adaptation.
        **ddpg: Other arguments of `DDPGLoss`.

    Raises:
        ValueError: If ``inner_learning_rate`` is negative, or the batch sizes do not fit.
    """

    def __init__(
        self,
        meta_network: TensorDictModuleBase,
        actor_network: TensorDictModuleBase,
        value_network: TensorDictModuleBase,
        *,
        inner_learning_rate: float = MAMLConfig.inner_learning_rate,
        **ddpg: Any,
    ) -> None:
        networks: list[Any] = [meta_network, actor_network, value_network]
        shapes = [torch.Size(getattr(network, "batch_size", ())) for network in networks]
        if not shapes[1] or shapes[1][:-1] != shapes[0] or shapes[2][: len(shapes[1])] != shapes[1]:
            raise ValueError(
                "meta_network, actor_network and value_network must have the batch sizes [*S], "
                f"[*S, T] and [*S, T], got {', '.join(str([*shape]) for shape in shapes)}"
            )
        if not inner_learning_rate >= 0:
            raise ValueError(f"inner_learning_rate must be >= 0, got {inner_learning_rate}")
        actor_network = deepcopy(actor_network).requires_grad_(False)
        start = dict(meta_network.named_parameters())
        with torch.no_grad():
            for name, parameter in actor_network.named_parameters():
                parameter.copy_(start[name].unsqueeze(len(shapes[0])))
        super().__init__(actor_network, value_network, **ddpg)
        self.meta_network = meta_network
        self.inner_learning_rate = inner_learning_rate

    @property
    def out_keys(self) -> list[NestedKey]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Entries that `forward` returns."""
        return [key for key in super().out_keys if key != "pre_tanh_magnitude"]

    def loss_actor(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute the loss of the adapted policies, reduced, and store these in ``actor_network``.

        Raises:
            ValueError: If the batch cannot be cut in halves.
        """
        if tensordict.batch_size[-1] % 2:
            raise ValueError(
                f"an even number of transitions is needed, to adapt and to judge, got "
                f"{tensordict.batch_size[-1]}"
            )
        support, query = tensordict.chunk(2, dim=-1)
        adapted = self.adapt(support)
        loss = self.policy_loss(adapted, query)
        kept = self.actor_network_params.flatten_keys(".")
        for key, value in adapted.items():
            kept[key].copy_(value.detach())
        self.n_imitated += self.trains(query)
        return self.reduce_seeds(loss), {}

    def adapt(self, tensordict: TensorDictBase) -> Parameters:
        """Return the policy's parameters ``[*S, T, ...]`` after one gradient step on each task.

        They are differentiable with respect to ``meta_network``. Transitions are ``[*S, T, B]``.
        """
        start = self.each_task()
        step = grad(lambda parameters: self.policy_loss(parameters, tensordict).sum())(start)
        return {key: value - self.inner_learning_rate * step[key] for key, value in start.items()}

    def policy_loss(self, parameters: Parameters, tensordict: TensorDictBase) -> Tensor:
        """Return ``L_i`` ``[*S, T]`` of policies with parameters ``[*S, T, ...]``, one per task."""

        def policy(states: TensorDictBase) -> TensorDictBase:
            return functional_call(self.actor_network, parameters, (states,))

        data = policy(self.current(tensordict))
        loss = self.mean_per_seed(self.actor_objective(data), tensordict)
        if not self.imitation:
            return loss
        return loss + self.imitation_weight * self.distance(policy, tensordict)

    def each_task(self) -> Parameters:
        """Return the policy's parameters before adaptation, as often as tasks, ``[*S, T, ...]``."""
        n_stacked = len(self.batch_size) - 1
        return {
            key: value.unsqueeze(n_stacked)
            .expand(*self.batch_size, *value.shape[n_stacked:])
            .contiguous()
            for key, value in self.meta_network.named_parameters()
        }
