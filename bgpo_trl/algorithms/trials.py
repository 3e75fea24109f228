"""Trials: which groups of behaviors are one task, found by playing one where another was shown."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bgpo_trl.seeding import stream_seed

__all__ = ["GroupTrials"]

_FITTING_SHARE = 0.9  # of a group's own demonstrations whose starts are to count as fitting
_Counts = dict[int, dict[int, list[int]]]  # successes and episodes, by groups shown and played


class GroupTrials:
    """Trials of one group's behavior in episodes that another group's demonstration begins.

    A task that looks different from different starts, such as a push to the left or to the right,
    forms several groups. The expert of one of them does not know what to do where its own
    demonstrations never began. Then

    1. a start *fits* a group if its distance to the nearest start of the group's demonstrations is
       at most the 90 % quantile of this distance among those starts themselves;
    2. where a start does not fit the demonstrated group, the episode is played by that group or by
       one that it fits, whichever Thompson sampling of their successes there selects;
    3. two groups are one task if playing one after demonstrations of the other has had
       ``successes`` together and been tried as many times each way, and if neither way the
       successes fall short, by more than a standard deviation, of half the rate that the group
       played has after its own demonstrations, from starts that fit.

    Args:
        starts: First latent of each demonstration that may be shown, float32 ``[N, 64]``.
        seeds: Seeds ``S``, which determine the sampling.
        smallest: Least number of demonstrations of a group, without which every start fits it.
        successes: See 3.
    """

    def __init__(
        self, starts: Tensor, *, seeds: Sequence[int], smallest: int = 10, successes: int = 5
    ) -> None:
        self._starts, self.smallest, self.successes = starts, smallest, successes
        self._streams = [stream_seed(seed, "trials") for seed in seeds]
        self._state: list[_Seed] = [_Seed() for _ in seeds]

    def begin(self, seed: int, start: Tensor, group: int) -> int:
        """Return the group that is to play an episode.

        Args:
            seed: Position of the seed.
            start: First latent of the episode, ``[64]``.
            group: Group of the demonstration.
        """
        state = self._state[seed]
        played, fits = group, self.fits(seed, start, group)
        if not fits:
            others = sorted({*state.shown.values()} - {group})
            arms = [group, *(other for other in others if self.fits(seed, start, other))]
            paid = state.after_others.get(group, {})
            counts = np.array([paid.get(arm, (0, 0)) for arm in arms])
            rng = np.random.default_rng((self._streams[seed], state.n_trials))
            state.n_trials += 1
            won, episodes = counts.T
            played = arms[int(rng.beta(1 + won, 1 + episodes - won).argmax())]
        state.episode = group, played, fits
        return played

    def playing(self, seed: int) -> int:
        """Return the group that plays the present episode of a seed."""
        return self._state[seed].episode[1]

    def end(self, seed: int, demonstration: int, success: bool) -> None:
        """Count the end of an episode, given the position of its demonstration in ``starts``."""
        state = self._state[seed]
        group, played, fits = state.episode
        counts = state.after_own if fits else state.after_others
        entry = counts.setdefault(group, {}).setdefault(played, [0, 0])
        entry[0] += success
        entry[1] += 1
        state.shown[demonstration] = group

    def regroup(self, seed: int, group: Tensor, numbers: Sequence[int]) -> None:
        """Assign demonstrations to groups anew, given the group ``[N]`` of each and all numbers.

        Counts of groups that are no more are forgotten.
        """
        state, known = self._state[seed], {*numbers}
        state.shown = {row: int(group[row]) for row in state.shown}
        state.after_own, state.after_others = (
            {
                shown: {played: entry for played, entry in of_shown.items() if played in known}
                for shown, of_shown in counts.items()
                if shown in known
            }
            for counts in (state.after_own, state.after_others)
        )

    def fits(self, seed: int, start: Tensor, group: int) -> bool:
        """Return whether a start ``[64]`` fits a group."""
        rows = [row for row, of in self._state[seed].shown.items() if of == group]
        if len(rows) < self.smallest:
            return True
        starts = self._starts[rows]
        apart = torch.cdist(starts, starts).fill_diagonal_(torch.inf).amin(-1)
        return bool(torch.cdist(start[None], starts).amin() <= apart.quantile(_FITTING_SHARE))

    def same_task(self, seed: int) -> tuple[int, int] | None:
        """Return two groups that are one task, or None."""
        counts = self._state[seed].after_others
        for one, other in combinations(sorted(counts), 2):
            (won, n), (won_back, n_back) = (
                counts[shown].get(played, (0, 0)) for shown, played in ((one, other), (other, one))
            )
            tried = min(n, n_back, won + won_back) >= self.successes
            if tried and self._pays(seed, one, other) and self._pays(seed, other, one):
                return one, other
        return None

    def _pays(self, seed: int, shown: int, played: int) -> bool:
        """Return whether a group is not much worse after another's demonstrations than its own."""
        state = self._state[seed]
        won, episodes = state.after_others[shown][played]
        own, of = state.after_own.get(played, {}).get(played, (0, 1))
        half = episodes * own / of / 2
        return won >= half - half**0.5

    def state_dict(self) -> dict[str, Any]:
        """Return what is counted, and the present episodes."""
        return {"seeds": [deepcopy(vars(state)) for state in self._state]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a `state_dict`."""
        self._state = [_Seed(**deepcopy(saved)) for saved in state["seeds"]]


@dataclass
class _Seed:
    """Counts of a seed.

    Attributes:
        shown: Group of each demonstration shown, by its position.
        after_own: Counts from starts that fit the group shown.
        after_others: Counts from starts that do not.
        n_trials: Number of choices made.
        episode: Groups shown and played in the present episode; whether its start fits the former.
    """

    shown: dict[int, int] = field(default_factory=dict)
    after_own: _Counts = field(default_factory=dict)
    after_others: _Counts = field(default_factory=dict)
    n_trials: int = 0
    episode: tuple[int, int, bool] = (0, 0, True)
