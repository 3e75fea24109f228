"""A policy conditioned on demonstrations, which acts without exploration noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.func import functional_call

__all__ = ["Policy"]


@dataclass(frozen=True)
class Policy:
    """Snapshot of a policy for test episodes, unaffected by further training.

    Attributes:
        actor: Network, called with ``parameters`` instead of its weights.
        state_key: Key of the state.
        parameters: By name in the actor. Leading dimensions: none, ``[T]`` (one network per task)
            or ``[T, M]`` (one per episode). In a stack of seeds, ``[S]`` comes first.
        context: Input besides the state, ``[T, M, C]``; None if the actor reads no context.
    """

    actor: TensorDictModuleBase
    state_key: NestedKey
    parameters: dict[str, Tensor]
    context: Tensor | None = None

    @classmethod
    def stack(cls, policies: Sequence[Policy], device: torch.device | str = "cpu") -> Policy:
        """Stack the policies of several seeds as one, ``[S]``, on a device."""
        first = policies[0]
        contexts = [policy.context for policy in policies if policy.context is not None]
        return cls(
            first.actor,
            first.state_key,
            {
                key: torch.stack([policy.parameters[key] for policy in policies]).to(device)
                for key in first.parameters
            },
            torch.stack(contexts).to(device) if contexts else None,
        )

    @torch.no_grad()
    def act(self, state: Tensor) -> Tensor:
        """Return actions ``[..., T, M, A]`` in [-1, 1] for states ``[..., T, M, features]``."""
        inputs: TensorDictBase = TensorDict({self.state_key: state}, state.shape[:-1])
        if self.context is not None:
            inputs["context"] = self.context
        functional_call(self.actor, self.parameters, (inputs,))
        return inputs["action"]

    def state_dict(self) -> dict[str, Any]:
        """Return parameters and context, the arguments of `Algorithm.policy`."""
        return {"parameters": self.parameters, "context": self.context}
