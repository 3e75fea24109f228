"""Policy distillation: a multi-task policy learns the actions of the tasks' teachers."""

from __future__ import annotations

from dataclasses import dataclass

from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch.nn.functional import gaussian_nll_loss
from torchrl.objectives import LossModule

from bgpo_trl.errors import missing_key

__all__ = ["DistillationLoss"]


class DistillationLoss(LossModule):
    """Negative log-likelihood of the teachers' actions (Rusu et al., 2016, Eq. 1, for Gaussians).

    Reads the ``in_keys`` of the policy, ``teacher_action`` ``[T, B, action_dim]`` and, if present,
    ``priority_weight`` ``[T, B]``, a factor of each state's loss; writes ``loss_distillation``
    ``[]``: ``-log N(teacher_action; loc, scale^2)``, summed over action components and tasks, mean
    over ``B``.

    Args:
        actor_network: Policy that writes ``loc`` and ``scale``.

    Raises:
        ValueError: From ``forward``, if an entry is missing or has the wrong shape, or the policy
            writes no distribution.
    """

    @dataclass
    class _AcceptedKeys:
        teacher_action: NestedKey = "teacher_action"
        loc: NestedKey = "loc"
        scale: NestedKey = "scale"
        priority_weight: NestedKey = "priority_weight"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    def __init__(self, actor_network: TensorDictModuleBase) -> None:
        super().__init__()
        self.actor_network = actor_network

    @property
    def functional(self) -> bool:
        """False, since the parameters stay in the network."""
        return False

    @property
    def out_keys(self) -> list[NestedKey]:
        """The keys that ``forward`` writes."""
        return ["loss_distillation"]

    @property
    def in_keys(self) -> list[NestedKey]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The keys that ``forward`` reads."""
        return [*self.actor_network.in_keys, self.tensor_keys.teacher_action]

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Return the loss for states and teachers' actions ``[T, B]``."""
        keys = self.tensor_keys
        if any(tensordict.get(key, None) is None for key in self.in_keys):
            raise missing_key("DistillationLoss", tensordict, self.in_keys)
        policy = self.actor_network(tensordict.select(*self.actor_network.in_keys))
        if policy.get(keys.loc, None) is None or policy.get(keys.scale, None) is None:
            raise missing_key("DistillationLoss, from its actor,", policy, [keys.loc, keys.scale])
        teacher_action = tensordict[keys.teacher_action].detach()
        if teacher_action.shape != policy[keys.loc].shape:
            raise ValueError(
                f"{keys.teacher_action!r} must be {[*policy[keys.loc].shape]}, as the policy's "
                f"{keys.loc!r} is, got {[*teacher_action.shape]}"
            )
        loss = gaussian_nll_loss(
            policy[keys.loc],
            teacher_action,
            policy[keys.scale].square(),
            full=True,
            reduction="none",
        )
        loss, weights = loss.sum(-1), tensordict.get(keys.priority_weight, None)
        if weights is not None:
            if weights.shape != loss.shape:
                raise ValueError(
                    f"{keys.priority_weight!r} must be one weight a state, {[*loss.shape]}, got "
                    f"{[*weights.shape]}"
                )
            loss = loss * weights
        return TensorDict({"loss_distillation": loss.mean(-1).sum()})
