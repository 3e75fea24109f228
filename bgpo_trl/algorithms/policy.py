"""A policy that was conditioned on demonstrations and acts without exploration noise."""

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
    """Copies of all that the actions of test episodes depend on; training does not change them.

    Attributes:
        actor: Network that is called with ``parameters`` in place of its own.
        state_key: Name of the state that it reads.
        parameters: By their names in the actor. Leading dimensions, where there are some, are
            those of the episodes: ``[T, ...]`` for a network a task, ``[T, M, ...]`` for one an
            episode; in a stack they follow ``[S]``.
        context: What the actor is conditioned on, ``[T, M, C]``; None if it reads no context.
    """

    actor: TensorDictModuleBase
    state_key: NestedKey
    parameters: dict[str, Tensor]
    context: Tensor | None = None

    @classmethod
    def stack(cls, policies: Sequence[Policy], device: torch.device | str = "cpu") -> Policy:
        """Return the policies of several seeds as one, ``[S]``, on a device."""
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
        """Return actions ``[..., T, M, 4]`` in [-1, 1] for states ``[..., T, M, features]``."""
        inputs: TensorDictBase = TensorDict({self.state_key: state}, state.shape[:-1])
        if self.context is not None:
            inputs["context"] = self.context
        functional_call(self.actor, self.parameters, (inputs,))
        return inputs["action"]

    def state_dict(self) -> dict[str, Any]:
        """Return parameters and context, of which `Algorithm.policy` makes the policy again."""
        return {"parameters": self.parameters, "context": self.context}
