"""Detection of an unknown task, by its novelty to groups that formed without it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from bgpo_trl.seeding import generators

if TYPE_CHECKING:
    from bgpo_trl.data.bank import DemonstrationBank


@dataclass(frozen=True)
class Detection:
    """Novelty of held-out demonstrations to the groups of networks that never saw one task.

    Attributes:
        known: Novelties of demonstrations of the other tasks, ``[S, K]`` for ``S`` networks.
        unknown: Novelties of demonstrations of the task left out, ``[S, U]``.
    """

    known: Tensor
    unknown: Tensor

    @property
    def area(self) -> Tensor:
        """Area under the ROC curve of each network, ``[S]``; see `roc_area`."""
        pairs = zip(self.known, self.unknown, strict=True)
        return torch.stack([roc_area(known, unknown) for known, unknown in pairs])

    @property
    def detected(self) -> Tensor:
        """Share of the unknown that belongs to no known group, ``[S]``."""
        return (self.unknown > 1).float().mean(-1)

    @property
    def false_alarms(self) -> Tensor:
        """Share of the known that belongs to no known group, ``[S]``."""
        return (self.known > 1).float().mean(-1)


def roc_area(known: Tensor, unknown: Tensor) -> Tensor:
    """Return the area under the ROC curve of "unknown if the novelty is high", ``[]``.

    It is the probability that a demonstration of the unknown is newer than one of the known
    (Mann and Whitney, 1947); equal novelties count half.

    Args:
        known: Novelties ``[K]``.
        unknown: Novelties ``[U]``.
    """
    from scipy import stats

    wins = stats.mannwhitneyu(unknown, known).statistic
    return torch.tensor(wins / (len(known) * len(unknown)))


def roc_curve(known: Tensor, unknown: Tensor) -> tuple[Tensor, Tensor]:
    """Return the ROC curve as shares ``[P]`` of false alarms and of detections, from 0 to 1.

    A point is a threshold: each of the novelties ``known`` ``[K]`` and ``unknown`` ``[U]``, and
    one above all of them.
    """
    thresholds = torch.cat([known, unknown]).unique().flip(0)
    above = [(values >= thresholds.unsqueeze(-1)).float().mean(-1) for values in (known, unknown)]
    false_alarms, detected = (torch.nn.functional.pad(share, (1, 0)) for share in above)
    return false_alarms, detected


@torch.no_grad()
def leave_one_out(
    bank: DemonstrationBank,
    task: int,
    *,
    seeds: Sequence[int],
    draws: int = 600,
) -> Detection:
    """Let groups form without one task, and measure the novelty of demonstrations of all tasks.

    Args:
        bank: Demonstrations, seen and held out, of at least two tasks.
        task: Label of the task to leave out.
        seeds: Seeds of the draws, one for each of ``S`` networks.
        draws: Demonstrations that each network learns from, drawn with replacement.

    Raises:
        ValueError: If the bank has no demonstration of another task to learn from or to test on, or
            none held out of the task.
    """
    seen, held_out = bank.seen(), bank.held_out()
    learned = seen.embedding[seen.task != task]
    known = held_out.embedding[held_out.task != task]
    unknown = held_out.embedding[held_out.task == task]
    if not len(learned) or not len(known) or not len(unknown):
        raise ValueError(
            f"leaving out task {task} takes demonstrations of it that are held out, and others "
            "both to learn from and held out: the bank lacks some"
        )
    from bgpo_trl.modules.behavior_groups import BehaviorGroups

    groups = BehaviorGroups(learned.shape[-1], batch_size=[len(seeds)])
    streams = generators(seeds, "leave one out")
    rows = torch.stack([torch.randint(len(learned), (draws,), generator=s) for s in streams])
    for row in rows.T:
        groups.adapt(learned[row])

    def novelty(embedding: Tensor) -> Tensor:
        return groups.lookup(embedding.expand(len(seeds), *embedding.shape)).novelty

    return Detection(novelty(known), novelty(unknown))
