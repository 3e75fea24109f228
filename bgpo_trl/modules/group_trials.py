"""Successes of one group's expert after the demonstrations of another: which are one task."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from itertools import combinations
from typing import Any

import numpy as np

_LEAST = 3  # successes of an expert after demonstrations of another group, to join the two

_Counts = dict[int, dict[int, list[int]]]  # successes and episodes, by group shown and expert


class GroupTrials:
    """Counts of a seed's episodes by group shown and expert, by which experts are selected.

    Args:
        seed: Seed of the selection.

    Attributes:
        after_own: Counts of episodes whose start fits the group shown.
        after_others: Counts of the other episodes.
        n_trials: Number of the other episodes.
    """

    def __init__(self, seed: int = 0) -> None:
        self.seed = seed
        self.after_own: _Counts = {}
        self.after_others: _Counts = {}
        self.n_trials = 0

    def select(self, group: int, others: Sequence[int]) -> int:
        """Return the group whose expert is to play where the start does not fit the group shown.

        Thompson sampling: of a success rate drawn for each from those counted after demonstrations
        of ``group``, the highest.
        """
        arms, paid = [group, *others], self.after_others.get(group, {})
        won, episodes = np.array([paid.get(arm, (0, 0)) for arm in arms]).T
        rng = np.random.default_rng((self.seed, self.n_trials))
        return arms[int(rng.beta(1 + won, 1 + episodes - won).argmax())]

    def count(self, group: int, expert: int, *, fits: bool, success: bool) -> None:
        """Count an episode, given the group shown and whether the start fits the group."""
        counts = self.after_own if fits else self.after_others
        entry = counts.setdefault(group, {}).setdefault(expert, [0, 0])
        entry[0] += success
        entry[1] += 1
        self.n_trials += not fits

    def keep(self, numbers: Sequence[int]) -> None:
        """Forget the counts of all other groups."""
        self.after_own, self.after_others = (
            {
                shown: {expert: entry for expert, entry in row.items() if expert in numbers}
                for shown, row in counts.items()
                if shown in numbers
            }
            for counts in (self.after_own, self.after_others)
        )

    def same_task(self) -> tuple[int, int] | None:
        """Return two groups that are one task, or None.

        Each one's expert has succeeded three times after demonstrations of the other, at a rate
        that falls short, by no more than a standard deviation, of half its rate after
        demonstrations of its own group. With fewer successes, experts that seldom succeed would be
        joined by chance.
        """
        for one, other in combinations(sorted(self.after_others), 2):
            if self._succeeds(one, other) and self._succeeds(other, one):
                return one, other
        return None

    def _succeeds(self, shown: int, expert: int) -> bool:
        won, episodes = self.after_others[shown].get(expert, (0, 0))
        own, of = self.after_own.get(expert, {}).get(expert, (0, 1))
        half = episodes * own / of / 2
        return won >= max(_LEAST, half - half**0.5)

    def state_dict(self) -> dict[str, Any]:
        """Return what is counted."""
        names = ("after_own", "after_others", "n_trials")
        return {name: deepcopy(getattr(self, name)) for name in names}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a `state_dict`."""
        vars(self).update(deepcopy(dict(state)))
