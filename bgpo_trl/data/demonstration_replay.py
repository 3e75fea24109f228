"""Demonstrations as experience: transitions of those that were shown in training episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.data.group_replay import GroupReplay, draw_shares

__all__ = ["DemonstrationReplay"]


class DemonstrationReplay:
    """Transitions of the demonstrations shown to each seed, drawn group by group.

    A transition has the latents of two successive frames, the action between them, and what the
    policy was told in the episode whose demonstration it was. The last one of a demonstration is a
    success: it terminates, with the reward that the episode would have paid for doing as shown.

    Args:
        bank: The demonstrations that episodes are drawn from, with their steps.
        generator: Sources of the draws, one for each of ``S`` seeds.
        state_key: Name of the latent.
        constant_keys: Entries that are constant within an episode, to be kept with each.
        capacity: Demonstrations remembered for each seed; then the oldest are forgotten.

    Raises:
        ValueError: If the bank has no steps, or none of some demonstration.
    """

    def __init__(
        self,
        bank: DemonstrationBank,
        *,
        generator: Sequence[torch.Generator],
        state_key: NestedKey = "latent",
        constant_keys: Sequence[NestedKey] = (),
        capacity: int = 100_000,
    ) -> None:
        if bank.steps is None:
            raise ValueError(
                "the bank has no steps of demonstrations to learn from: make it anew with "
                "`python -m bgpo_trl.encoders.make_bank`, or set demonstration_share to 0"
            )
        if (bank.steps.length < 2).any():
            row = int((bank.steps.length < 2).nonzero()[0])
            raise ValueError(
                f"the bank has no steps of demonstration {row} to learn from: make it anew with "
                "`python -m bgpo_trl.encoders.make_bank`, or set demonstration_share to 0"
            )
        self._steps = bank.steps
        self._generators = list(generator)
        self._state_key, self._constant_keys = state_key, list(constant_keys)
        self._shown = GroupReplay(
            capacity, generator=generator, keys=["demo_index", "reward", *constant_keys]
        )

    def __len__(self) -> int:
        """Returns the number of demonstrations that every seed was shown at least."""
        return len(self._shown)

    def add(
        self, episode: TensorDictBase, reward: Tensor, group: Tensor, mask: Tensor | None = None
    ) -> None:
        """Remembers the demonstration of an episode of each seed.

        Args:
            episode: Batch size ``[S]``, with ``"demo_index"`` int64 and the constant entries.
            reward: Paid at the demonstration's end, float32 ``[S]``.
            group: The group of each, int64 ``[S]``.
            mask: Bool ``[S]``, which seeds add theirs; None for all.
        """
        self._shown.add(episode.copy().set("reward", reward), group, mask)

    def sample(self, group: Tensor) -> TensorDict:
        """Draws for each row a shown demonstration of its group, and one of its transitions.

        Args:
            group: As in `GroupReplay.sample`, ``[S, R]``.

        Returns:
            Batch size ``[S, R]``, as `GroupReplay.sample`: the state, the constant entries,
            ``"action"``, ``"priority_weight"`` and, under ``"next"``, the state, ``"reward"`` and
            ``"terminated"``.
        """
        shown = self._shown.sample(group)
        steps, share = self._steps, draw_shares(group, self._generators)
        number = shown["demo_index"]
        n_steps = steps.length[number] - 1
        step = (share * n_steps).long()
        frame = steps.first[number] + step
        ends = (step == n_steps - 1).unsqueeze(-1)
        return TensorDict(
            {
                self._state_key: steps.latents(frame),
                "action": steps.actions(frame),
                "priority_weight": shown["priority_weight"],
                **{key: shown[key] for key in self._constant_keys},
                "next": {
                    self._state_key: steps.latents(frame + 1),
                    "reward": shown["reward"].unsqueeze(-1) * ends,
                    "terminated": ends,
                },
            },
            group.shape,
        )

    def state_dict(self) -> dict[str, Any]:
        """Returns all that future samples depend on."""
        return self._shown.state_dict()

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restores what `state_dict` returned, so that the same samples follow."""
        self._shown.load_state_dict(state_dict)
