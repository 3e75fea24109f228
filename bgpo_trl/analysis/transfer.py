"""Forward transfer between tasks that are presented one after the other."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from bgpo_trl.analysis import metrics
from bgpo_trl.analysis.comparison import Run, Values, starts


def expected_own_episodes(begun: Sequence[int], task: int, episodes: ArrayLike) -> Values:
    """Return the expected number of a task's own training episodes after ``episodes`` ``[E]``.

    An episode is of each task presented so far with equal probability. ``begun`` are the episodes
    from which tasks are presented.
    """
    later = sorted({start for start in begun if start >= begun[task]})
    played = np.zeros(np.shape(episodes))
    for start, end in pairwise([*later, np.inf]):
        presented = sum(other <= start for other in begun)
        played += (np.clip(episodes, start, end) - start) / presented
    return played


def forward_transfer(run: Run, reference: Run) -> Values:
    """Return the forward transfer to each task but the first, ``[S, T - 1]``.

    Computed as in Continual World (`metrics.forward_transfer`), from the area under the task's
    curve over its own phase and the mean area of a reference. As an episode is of any of the
    presented tasks, both areas are taken over equally many of the task's own episodes. The first
    task is left out, since nothing precedes it. Tasks of the reference may have another order.
    """
    begun, gains = starts(run), []
    for task, end in enumerate([*begun[2:], run.curves.episodes[-1]], 1):
        other = reference.tasks.index(run.tasks[task])
        of_reference = expected_own_episodes(
            starts(reference), other, reference.curves.episodes[-1]
        )
        length = min(float(expected_own_episodes(begun, task, end)), float(of_reference))
        reached = _own_area(reference, other, length).mean()
        gains.append(metrics.forward_transfer(_own_area(run, task, length), reached))
    return np.stack(gains, axis=-1)


def _own_area(run: Run, task: int, length: float) -> Values:
    """Return the area under a task's curve over its first ``length`` own episodes, ``[S]``."""
    own = expected_own_episodes(starts(run), task, run.curves.episodes)
    curve = run.curves.success[:, own > 0, task]
    own = own[own > 0]
    before = own < length
    last = [np.interp(length, [0, *own], [0, *of_seed]) for of_seed in curve]
    heights = np.column_stack([curve[:, before], last])
    return metrics.area_under_curve(heights, np.append(own[before], length))
