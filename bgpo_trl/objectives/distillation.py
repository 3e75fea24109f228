"""Policy distillation: the multi-task policy learns which actions the tasks' teachers take."""

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

    Reads the ``in_keys`` of the policy and ``"teacher_action"`` ``[T, B, action_dim]``. Returns
    ``"loss_distillation"`` ``[]``: ``-log N(teacher_action; loc, scale^2)``, summed over action
    components and tasks, mean over ``B``.

    Args:
        actor_network: policy that writes ``"loc"`` and ``"scale"``.
    """

    @dataclass
    class _AcceptedKeys:
        """Names of the entries, to be changed with ``set_keys``.

        Attributes:
            teacher_action: what the teacher does in a state.
            loc: mean of the policy's actions.
            scale: their standard deviation.
        """

        teacher_action: NestedKey = "teacher_action"
        loc: NestedKey = "loc"
        scale: NestedKey = "scale"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    def __init__(self, actor_network: TensorDictModuleBase) -> None:
        super().__init__()
        self.actor_network = actor_network

    @property
    def functional(self) -> bool:
        """False: the parameters stay in the network."""
        return False

    @property
    def out_keys(self) -> list[NestedKey]:
        """Entries that are returned."""
        return ["loss_distillation"]

    @property
    def in_keys(self) -> list[NestedKey]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Entries that are read."""
        return [*self.actor_network.in_keys, self.tensor_keys.teacher_action]

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Compute the loss; reads and returns what the class says.

        Args:
            tensordict: states and the teachers' actions ``[T, B]``.

        Raises:
            ValueError: if an entry is missing, or the policy writes no distribution.
        """
        keys = self.tensor_keys
        if any(tensordict.get(key, None) is None for key in self.in_keys):
            raise missing_key("DistillationLoss", tensordict, self.in_keys)
        told = self.actor_network(tensordict.select(*self.actor_network.in_keys))
        if told.get(keys.loc, None) is None or told.get(keys.scale, None) is None:
            raise missing_key("DistillationLoss, from its actor,", told, [keys.loc, keys.scale])
        loss = gaussian_nll_loss(
            told[keys.loc],
            tensordict[keys.teacher_action].detach(),
            told[keys.scale].square(),
            full=True,
            reduction="none",
        )
        return TensorDict({"loss_distillation": loss.sum(-1).mean(-1).sum()})
