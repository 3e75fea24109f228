"""Replay of the demonstrations shown in training episodes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.data.replay import GroupReplay, draw_for_rows

_CAPACITY = 100_000  # demonstrations kept for each seed; the oldest are overwritten


class DemonstrationReplay:
    """Transitions of the demonstrations shown to each seed, sampled by group.

    A transition has two successive latents, the action between them, and the constant entries (such
    as the context) of the episode in which the demonstration was shown. The last transition of a
    demonstration counts as a success: it terminates, with the reward given to `add`.

    Args:
        bank: Demonstrations that episodes are drawn from, with their steps.
        generator: Random generators for sampling, one for each of ``S`` seeds.
        noise: Standard deviation of Gaussian noise on states to imitate, by default the bank's.
        pace: Factor of actions to imitate, which stay in [-1, 1].
        limit: Largest size of a latent's numbers, as policies read them; None for none.
        joints: Joints in each frame of the bank's steps, as policies read them, float32
            ``[F, J]``, by which ``"latent_and_joints"`` stands in place of ``"latent"``; or None.
        constant_keys: Entries that are constant within an episode, stored with each demonstration.
        own_constants: Whether a transition comes with the constant entries of its own
            demonstration, or else with those of any one of its group.
        n_steps: Largest number of steps of a drawn transition, as in `GroupReplay`.
        gamma: Discount of the reward of a transition of several steps.

    Raises:
        ValueError: If the bank lacks the steps of a demonstration.
    """

    def __init__(
        self,
        bank: DemonstrationBank,
        *,
        generator: Sequence[torch.Generator],
        noise: float | None = None,
        pace: float = 1.0,
        limit: float | None = None,
        joints: Tensor | None = None,
        constant_keys: Sequence[NestedKey] = (),
        own_constants: bool = True,
        n_steps: int = 1,
        gamma: float = 1.0,
    ) -> None:
        if bank.steps is None:
            raise ValueError(
                "the bank has no steps of demonstrations to learn from: choose --algorithm "
                "bgpo-experts, or make the bank again by encoders that were trained with actions "
                "(docs/extending.md, Your demonstrations)"
            )
        short = (bank.steps.length < 2).nonzero()
        if len(short):
            row = int(short[0])
            raise ValueError(
                f"the bank has no steps of demonstration {row} to learn from: make it again with "
                "`bgpo bank`, or choose --algorithm bgpo-experts"
            )
        self._steps, self._joints = bank.steps, joints
        self._key = "latent" if joints is None else "latent_and_joints"
        self._generators = list(generator)
        self.noise = bank.noise if noise is None else noise
        self._pace = pace
        self._n_steps, self._gamma = n_steps, gamma
        self._limit = math.inf if limit is None else limit
        self._own_constants = own_constants
        self._constant_keys = list(constant_keys)
        self._shown = GroupReplay(
            _CAPACITY,
            generator=generator,
            keys=["demo_index", "reward", *constant_keys],
            source_key="demo_index",
        )

    def __len__(self) -> int:
        """Return the smallest number of demonstrations held for a seed."""
        return len(self._shown)

    def add(
        self, episode: TensorDictBase, reward: Tensor, group: Tensor, mask: Tensor | None = None
    ) -> None:
        """Store the demonstration of an episode of each seed.

        Args:
            episode: Batch size ``[S]``, with ``"demo_index"`` int64 and the constant entries.
            reward: Reward of the demonstration's last transition, float32 ``[S]``.
            group: Group of each demonstration, int64 ``[S]``.
            mask: Seeds that store theirs, bool ``[S]``; ``None`` for all.
        """
        self._shown.add(episode.copy().set("reward", reward), group, mask)

    def draw(
        self, group: Tensor, *, generator: Sequence[torch.Generator] | None = None
    ) -> dict[NestedKey, Tensor]:
        """Draw, for each row, a demonstration of the row's group and one of its transitions.

        Args:
            group: Group of each row, int64 ``[S, *R]``; -1 as for `GroupReplay.sample`.
            generator: Random generators of the seeds, in place of the replay's.

        Returns:
            By key, ``[S, *R, ...]``: ``"latent"``, the constant entries, ``"action"``,
            ``"priority_weight"`` and, under ``"next"``, ``"latent"``, ``"reward"``,
            ``"terminated"`` and ``"done"``.
        """
        entries, reward, frame, left = self._draw_frames(group, generator)
        n_taken = left.clamp(max=self._n_steps)
        ends = (left == n_taken).unsqueeze(-1)
        reward = reward * self._gamma ** (n_taken - 1)
        several = {"steps_to_next_obs": n_taken.unsqueeze(-1)} if self._n_steps > 1 else {}
        return {
            **entries,
            **several,
            self._key: self._states(frame),
            ("next", self._key): self._states(frame + n_taken),
            ("next", "reward"): reward.unsqueeze(-1) * ends,
            ("next", "terminated"): ends,
            ("next", "done"): ends,
        }

    def draw_actions(
        self, group: Tensor, *, generator: Sequence[torch.Generator] | None = None
    ) -> dict[NestedKey, Tensor]:
        """Draw latents, with noise, and actions to imitate: as `draw`, without ``"next"``."""
        entries, _, frame, _ = self._draw_frames(group, generator)
        entries["action"] = (self._pace * entries["action"]).clamp(-1.0, 1.0)
        return {**entries, self._key: self.blur(self._states(frame), group, generator)}

    def blur(
        self, state: Tensor, group: Tensor, generator: Sequence[torch.Generator] | None = None
    ) -> Tensor:
        """Return states to imitate ``[S, *R, features]`` of rows ``[S, *R]`` with noise."""
        sources = self._generators if generator is None else generator
        return state + self.noise * draw_for_rows(torch.randn, group, sources, state.shape[-1])

    def _states(self, frame: Tensor) -> Tensor:
        """Return what policies read of frames int64 ``[...]``, float32 ``[..., features]``."""
        latent = self._steps.latents(frame).clamp(-self._limit, self._limit)
        return latent if self._joints is None else torch.cat([latent, self._joints[frame]], -1)

    def _draw_frames(
        self, group: Tensor, generator: Sequence[torch.Generator] | None
    ) -> tuple[dict[NestedKey, Tensor], Tensor, Tensor, Tensor]:
        """Draw a frame of a demonstration for each row ``[S, *R]``.

        Return action, weight and constant entries by key; the reward of the demonstration; the
        position of the frame; the number of steps from it to the end.
        """
        sources = self._generators if generator is None else generator
        shown, steps = self._shown.draw(group, generator=sources), self._steps
        share = draw_for_rows(torch.rand, group, sources, dtype=torch.float64)
        number, constants = shown["demo_index"], shown
        if not self._own_constants:
            constants = self._shown.draw(group, generator=sources, keys=self._constant_keys)
        n_steps = steps.length[number] - 1
        step = (share * n_steps).long()
        frame = steps.first[number] + step
        entries: dict[NestedKey, Tensor] = {
            "action": steps.actions(frame),
            "priority_weight": shown["priority_weight"],
            **{key: constants[key] for key in self._constant_keys},
        }
        return entries, shown["reward"], frame, n_steps - step

    def regroup(self, seed: int, group: Tensor) -> None:
        """Assign demonstrations of a seed to groups anew, from the group of each in the bank."""
        self._shown.regroup(seed, group)

    def clear(self, seed: int) -> None:
        """Discard the demonstrations of a seed, given its position."""
        self._shown.clear(seed)

    def state_dict(self) -> dict[str, Any]:
        """Return the stored demonstrations and the states of the generators."""
        return self._shown.state_dict()

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore a `state_dict`, so that the same samples follow."""
        self._shown.load_state_dict(state_dict)
