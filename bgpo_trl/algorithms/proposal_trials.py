"""Which policy plays an episode: the clone alone, or what critics choose."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any

import numpy as np

__all__ = ["ProposalTrials"]

_KEPT = 0.97  # weight of an outcome after a further episode: about the last 33 count
_LATEST = 200  # outcomes that are kept; older ones would weigh less than a hundredth
_ENOUGH = 20  # episodes of the critics' choice before it can be trusted

Outcome = tuple[int, bool]  # demonstration of an episode, and whether the episode succeeded


class ProposalTrials:
    """Successes of a clone and of the critics' choice (`ProposalPolicy`), by group and seed.

    RL makes a policy faster and better than its demonstrations, but at first the critics choose
    badly. A robot in use should not pay for that. Therefore

    1. the clone alone plays the first ``clone_episodes`` training episodes of a group, then every
       second one while it is better than the critics' choice (2), and otherwise one in
       ``1 / clone_share``; while it is better, it also plays all trials of experts (`GroupLookup`),
       which are to tell whether two groups are one task, and would not by a policy that fails; the
       critics choose in all others, since they learn only from what they have chosen;
    2. outside training, the critics choose if what they chose has succeeded at least as often as
       the clone alone, in the latest training episodes of each, about 33. Else, and before 20
       episodes of theirs, the clone acts.

    Only episodes count whose demonstration is of the group that played, today. The first
    demonstrations of a new task often belong to the group of another task, whose networks fail;
    when the new task gets a group of its own, these failures are no longer counted against the
    networks that failed.

    Args:
        n_seeds: Number of seeds ``S``.
        clone_episodes: See 1.
        clone_share: See 1.

    Examples:
        >>> trials = ProposalTrials(1, clone_episodes=2, clone_share=0.25)
        >>> [(trials.begin(0, group=7), trials.end(0, success=True, group=7))[0] for _ in range(8)]
        [True, True, False, True, False, True, False, True]
        >>> trials.clone_is_better(0, group=7)  # the critics have hardly been tried
        True
    """

    def __init__(self, n_seeds: int, *, clone_episodes: int, clone_share: float) -> None:
        self.clone_episodes, self.clone_share = clone_episodes, clone_share
        self._groups: list[dict[int, _Record]] = [{} for _ in range(n_seeds)]
        self._playing: list[tuple[int, bool]] = [(0, False)] * n_seeds

    @property
    def only_clone(self) -> list[bool]:
        """Whether the clone plays the present episode of each seed."""
        return [alone for _, alone in self._playing]

    def begin(self, seed: int, group: int, *, trial: bool = False) -> bool:
        """Return whether the clone alone plays the training episode that begins."""
        record = self._groups[seed].setdefault(group, _Record())
        better = self.clone_is_better(seed, group)
        alone = record.episodes < self.clone_episodes or (trial and better)
        if not alone:
            record.due += max(0.5, self.clone_share) if better else self.clone_share
            alone = record.due > 1 - 1e-6
            record.due -= alone
        self._playing[seed] = group, alone
        return alone

    def end(self, seed: int, success: bool, *, group: int, demonstration: int = 0) -> None:
        """Count the end of a training episode of a seed.

        Args:
            seed: Position of the seed.
            success: Whether the episode succeeded.
            group: Group of its demonstration; the episode does not count if another group played.
            demonstration: Position of the demonstration in the bank.
        """
        playing, alone = self._playing[seed]
        record = self._groups[seed].setdefault(playing, _Record())
        record.episodes += 1
        if group == playing:
            outcomes = record.clone if alone else record.choice
            outcomes.append((demonstration, success))
            del outcomes[:-_LATEST]

    def clone_is_better(self, seed: int, group: int) -> bool:
        """Return whether the clone has succeeded more often than what the critics chose."""
        record = self._groups[seed].get(group, _Record())
        # Sums of equal rates may differ in their last digit.
        worse = _rate(record.choice) < _rate(record.clone) - 1e-9
        return len(record.choice) < _ENOUGH or worse

    def follow(self, seed: int, groups: Sequence[int], group_of: Sequence[int]) -> None:
        """Forget what does not fit the groups of today.

        Args:
            seed: Position of the seed.
            groups: Numbers of its groups; all others are forgotten.
            group_of: Group of each demonstration of the bank.
        """
        known = {*groups}
        self._groups[seed] = {g: r for g, r in self._groups[seed].items() if g in known}
        for group, record in self._groups[seed].items():
            for outcomes in (record.clone, record.choice):
                outcomes[:] = [outcome for outcome in outcomes if group_of[outcome[0]] == group]

    def state_dict(self) -> dict[str, Any]:
        """Return what is counted, and the present episodes."""
        counted = [{g: vars(deepcopy(r)) for g, r in groups.items()} for groups in self._groups]
        return {"groups": counted, "playing": [*self._playing]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a `state_dict`."""
        self._groups = [
            {group: _Record(**deepcopy(saved)) for group, saved in groups.items()}
            for groups in state["groups"]
        ]
        self._playing = [(group, alone) for group, alone in state["playing"]]


@dataclass
class _Record:
    """Training episodes of a group, and the latest outcomes of the clone and the choice."""

    episodes: int = 0
    due: float = 0.0  # what is due to the clone of the later ones, less what it has played
    clone: list[Outcome] = field(default_factory=list)
    choice: list[Outcome] = field(default_factory=list)


def _rate(outcomes: Sequence[Outcome]) -> float:
    """Return the share of successes, the latest with the largest weight; 0 of none."""
    weight = _KEPT ** np.arange(len(outcomes))[::-1]
    return float(weight @ [success for _, success in outcomes] / weight.sum()) if outcomes else 0.0
