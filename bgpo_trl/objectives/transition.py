"""Entries of transitions that the networks of a loss read."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase

from bgpo_trl.errors import missing_key

__all__ = ["TransitionInputs", "TransitionKeys"]


@dataclass
class TransitionKeys:
    """Names of the entries of an off-policy loss, to be changed with its ``set_keys``."""

    action: NestedKey = "action"
    """Action of a transition, and of the actor."""
    pre_tanh_action: NestedKey = "pre_tanh_action"
    """Output of the actor before its tanh."""
    log_prob: NestedKey = "action_log_prob"
    """Log-probability of an action drawn from the actor."""
    state_action_value: NestedKey = "state_action_value"
    """Output of the critics."""
    reward: NestedKey = "reward"
    """Reward, under ``"next"``."""
    done: NestedKey = "done"
    """Whether the episode is over, under ``"next"``; accepted and not needed."""
    terminated: NestedKey = "terminated"
    """Whether nothing can follow, under ``"next"``: ends the bootstrap."""
    priority: NestedKey = "td_error"
    """Squared error of the critics, written for prioritized replay."""
    priority_weight: NestedKey = "priority_weight"
    """Factor of each transition's loss."""
    demonstrated: NestedKey = "demonstrated"
    """Whether the action is that of a demonstration."""


class TransitionInputs:
    """Input of an actor and its critics, in the states and the next states of transitions.

    An entry that is constant within an episode is not stored a second time under ``"next"``: its
    next value is read from the root. Entries are detached; a missing one raises ``ValueError``.

    Args:
        reader: Name of the loss, for messages.
        actor_network: Policy.
        value_network: Q-function; entries that the actor writes are not part of the input.
        constant_keys: Entries that are constant within an episode.

    Attributes:
        keys: All entries of the input.
        constant_keys: Those that are constant within an episode.
        moving_keys: The others.

    Example:
        >>> from bgpo_trl.modules.actor_critic import Actor, Critic
        >>> inputs = TransitionInputs("DDPGLoss", Actor(96), Critic(96), ["behavior"])
        >>> inputs.moving_keys
        ['latent']
    """

    def __init__(
        self,
        reader: str,
        actor_network: TensorDictModuleBase,
        value_network: TensorDictModuleBase,
        constant_keys: Sequence[NestedKey] = (),
    ) -> None:
        self.reader = reader
        written = set(actor_network.out_keys)
        read = [*actor_network.in_keys, *(k for k in value_network.in_keys if k not in written)]
        self.keys: list[NestedKey] = [*dict.fromkeys(unravel_key(key) for key in read)]
        self.constant_keys = [unravel_key(key) for key in constant_keys]
        unknown = [key for key in self.constant_keys if key not in self.keys]
        if unknown:
            raise ValueError(f"constant_keys must be among {self.keys}, got {unknown}")
        self.moving_keys = [key for key in self.keys if key not in self.constant_keys]

    def select(
        self, tensordict: TensorDictBase, keys: Iterable[NestedKey], where: str = ""
    ) -> TensorDictBase:
        """Return entries of a batch ``[*S, *B]``; ``where`` specifies the reader in errors."""
        try:
            return tensordict.select(*keys).detach()
        except KeyError:
            raise missing_key(self.reader + where, tensordict, keys) from None

    def current(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the input in the states of transitions ``[*S, *B]``."""
        return self.select(tensordict, self.keys)

    def following(self, tensordict: TensorDictBase, names: TransitionKeys) -> TensorDictBase:
        """Return the input in the next states of transitions ``[*S, *B]``.

        Raises:
            ValueError: If the reward, the termination or an entry is missing under ``"next"``.
        """
        successor = tensordict.get("next", None)
        if successor is None or successor.get(names.reward, None) is None:
            raise missing_key(self.reader, tensordict, [("next", names.reward)])
        if successor.get(names.terminated, None) is None:
            # The estimator would read "done" in its place, and stop at truncation too.
            raise ValueError(
                f"the batch lacks ('next', {names.terminated!r}): store it, since only it "
                "distinguishes a success from a time-out"
            )
        data = self.select(successor, self.moving_keys, ", under 'next',")
        for key in self.constant_keys:
            data.set(key, tensordict[key])
        return data
