"""Which policy plays an episode: the clone alone, or what critics choose."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any

__all__ = ["ProposalTrials"]

_KEPT = 0.97  # weight of an outcome after a further episode: about the last 33 count
_ENOUGH = 15.0  # weight of the episodes of the critics' choice before it can be trusted


class ProposalTrials:
    """Successes of a clone and of the critics' choice (`ProposalPolicy`), by group and seed.

    RL makes a policy faster and better than its demonstrations, but at first the critics choose
    badly. A robot in use should not pay for that. Therefore

    1. the clone alone plays the first ``clone_episodes`` training episodes of a group, and then one
       in ``1 / clone_share``; the critics choose in all others, since they learn only from what
       they have chosen;
    2. outside training, the critics choose if what they chose has succeeded at least as often as
       the clone alone, in the latest training episodes of each, about 33. Else, and before 20
       episodes of theirs, the clone acts.

    Args:
        n_seeds: Number of seeds ``S``.
        clone_episodes: See 1.
        clone_share: See 1.

    Examples:
        >>> trials = ProposalTrials(1, clone_episodes=2, clone_share=0.25)
        >>> [(trials.begin(0, group=7), trials.end(0, success=True))[0] for _ in range(8)]
        [True, True, False, False, False, True, False, False]
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

    def begin(self, seed: int, group: int) -> bool:
        """Return whether the clone alone plays the training episode that begins."""
        record = self._groups[seed].setdefault(group, _Record())
        alone = self.is_clones(record.episodes)
        self._playing[seed] = group, alone
        return alone

    def is_clones(self, episode: int) -> bool:
        """Return whether the clone plays a group's training episode, counted from 0."""
        later = episode - self.clone_episodes
        # One in 1 / clone_share of the later episodes, evenly spread.
        due = int((later + 1) * self.clone_share) > int(later * self.clone_share)
        return later < 0 or due

    def end(self, seed: int, success: bool) -> None:
        """Count the end of a training episode of a seed."""
        group, alone = self._playing[seed]
        record = self._groups[seed].setdefault(group, _Record())
        record.episodes += 1
        counts = record.clone if alone else record.choice
        counts[:] = [_KEPT * counts[0] + success, _KEPT * counts[1] + 1]

    def clone_is_better(self, seed: int, group: int) -> bool:
        """Return whether the clone has succeeded more often than what the critics chose."""
        record = self._groups[seed].get(group, _Record())
        (cloned, of_clone), (chosen, of_choice) = record.clone, record.choice
        return of_choice < _ENOUGH or chosen * of_clone < cloned * of_choice

    def keep(self, seed: int, groups: Sequence[int]) -> None:
        """Forget all other groups of a seed."""
        known = {*groups}
        self._groups[seed] = {g: r for g, r in self._groups[seed].items() if g in known}

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
    """Training episodes of a group; weighted successes and episodes of the clone and the choice."""

    episodes: int = 0
    clone: list[float] = field(default_factory=lambda: [0.0, 0.0])
    choice: list[float] = field(default_factory=lambda: [0.0, 0.0])
