"""Detection of an unknown task, by the activity of groups that formed without it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import torch
from torch import Tensor

from bgpo_trl.configs import GWRBConfig
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.modules.behavior_groups import BehaviorGroups
from bgpo_trl.seeding import generators


@dataclass(frozen=True)
class Detection:
    """Activities of held-out demonstrations in the groups of networks that never saw one task.

    Attributes:
        known: Activities of demonstrations of the other tasks, ``[S, K]`` for ``S`` networks.
        unknown: Activities of demonstrations of the task left out, ``[S, U]``.
        threshold: Activity below which a demonstration is of no known group.
    """

    known: Tensor
    unknown: Tensor
    threshold: float

    @property
    def area(self) -> Tensor:
        """Area under the ROC curve of each network, ``[S]``; see `roc_area`."""
        pairs = zip(self.known, self.unknown, strict=True)
        return torch.stack([roc_area(known, unknown) for known, unknown in pairs])

    @property
    def detected(self) -> Tensor:
        """Share of the unknown that falls below the threshold, ``[S]``."""
        return (self.unknown < self.threshold).float().mean(-1)

    @property
    def false_alarms(self) -> Tensor:
        """Share of the known that falls below the threshold, ``[S]``."""
        return (self.known < self.threshold).float().mean(-1)


def roc_area(known: Tensor, unknown: Tensor) -> Tensor:
    """Return the area under the ROC curve of "unknown if the activity is low", ``[]``.

    It is the probability that a demonstration of the unknown is less active than one of the known
    (Mann and Whitney, 1947); equal activities count half.

    Args:
        known: Activities ``[K]``.
        unknown: Activities ``[U]``.
    """
    difference = known.unsqueeze(-1) - unknown
    return (difference > 0).float().mean() + 0.5 * (difference == 0).float().mean()


def roc_curve(known: Tensor, unknown: Tensor) -> tuple[Tensor, Tensor]:
    """Return the ROC curve as shares ``[P]`` of false alarms and of detections, from 0 to 1.

    A point is a threshold: each of the activities ``known`` ``[K]`` and ``unknown`` ``[U]``, and
    one below all of them.
    """
    thresholds = torch.cat([known, unknown]).unique()
    below = [(values <= thresholds.unsqueeze(-1)).float().mean(-1) for values in (known, unknown)]
    false_alarms, detected = (torch.nn.functional.pad(share, (1, 0)) for share in below)
    return false_alarms, detected


@torch.no_grad()
def leave_one_out(
    bank: DemonstrationBank,
    task: int,
    config: GWRBConfig,
    *,
    seeds: Sequence[int],
    draws: int = 600,
) -> Detection:
    """Let groups form without one task, and measure the activity of demonstrations of all tasks.

    Args:
        bank: Demonstrations, seen and held out, of at least two tasks.
        task: Label of the task to leave out.
        config: The network that finds the groups.
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
    groups = BehaviorGroups(learned.shape[-1], batch_size=[len(seeds)], **asdict(config))
    streams = generators(seeds, "leave one out")
    rows = torch.stack([torch.randint(len(learned), (draws,), generator=s) for s in streams])
    for row in rows.T:
        groups.adapt(learned[row])

    def activity(embedding: Tensor) -> Tensor:
        return groups.lookup(embedding.expand(len(seeds), *embedding.shape)).activity

    return Detection(activity(known), activity(unknown), config.activity_threshold)
