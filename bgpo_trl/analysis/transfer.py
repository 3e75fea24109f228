"""Forward transfer between tasks that are presented one after the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from bgpo_trl.analysis import metrics
from bgpo_trl.analysis.comparison import Run
from bgpo_trl.analysis.scores import Values
from bgpo_trl.analysis.statistics import Estimate, contrast


def expected_own_episodes(
    begun: Sequence[int], task: int, episodes: ArrayLike, *, practised: bool = True
) -> Values:
    """Return the expected number of a task's own training episodes after ``episodes`` ``[E]``.

    An episode is of each task presented so far with equal probability; if earlier tasks are not
    ``practised``, of each of the newest. ``begun`` are the episodes from which tasks are presented.
    """
    later = sorted({start for start in begun if start >= begun[task]})
    played = np.zeros(np.shape(episodes))
    for start, end in pairwise([*later, np.inf]):
        newest = max(other for other in begun if other <= start)
        drawn = [other <= start if practised else other == newest for other in begun]
        if drawn[task]:
            played += (np.clip(episodes, start, end) - start) / sum(drawn)
    return played


def forward_transfer(run: Run, reference: Run) -> Estimate | None:
    """Return the mean forward transfer to all tasks but the first, with its 95 % interval.

    Computed as in Continual World (`metrics.forward_transfer`), from the areas of `own_areas`,
    means over seeds. The interval is Welch's of the seeds' contributions to first order (the delta
    method), so that the seeds of the reference count, too. None if the reference leaves nothing to
    gain on a task.
    """
    ours, theirs = own_areas(run, reference)
    area, height = ours.mean(0), theirs.mean(0)
    left = 1 - height
    if (left == 0).any():
        return None
    gained = contrast(
        [(ours / left).mean(-1), (theirs * (1 - area) / left**2).mean(-1)], [1.0, -1.0]
    )
    value = float(metrics.forward_transfer(area, height).mean())
    return replace(gained, value=value).interval()


def own_areas(run: Run, reference: Run) -> tuple[Values, Values]:
    """Return the areas under each task's curves of a run and a reference, ``[S, T - 1]`` each.

    The mean height of a task's curve from the first to the last test of its own phase. As an
    episode is of any of the presented tasks, curves are over the expected number of the task's own
    episodes, and the reference's is read off at the tests of the run: learners with the same curve
    have the same area. The first task is left out, since nothing precedes it. Tasks of the
    reference may have another order.
    """
    begun, areas = run.starts, []
    for task, end in enumerate([*begun[2:], run.last], 1):
        own, curves = _own_curves(run, task)
        of_reference, others = _own_curves(reference, reference.tasks.index(run.tasks[task]))
        last = min(float(_own_episodes(run, task, end)), of_reference[-1])
        first = min(max(own[0], of_reference[0]), last)
        tests = np.array([first, *own[(own > first) & (own < last)], last])
        areas.append((_mean_height(tests, own, curves), _mean_height(tests, of_reference, others)))
    ours, theirs = zip(*areas, strict=True)
    return np.stack(ours, axis=-1), np.stack(theirs, axis=-1)


def _own_curves(run: Run, task: int) -> tuple[Values, Values]:
    """Return a task's expected own episodes at its tests, ``[E]``, and the curves, ``[S, E]``."""
    own = _own_episodes(run, task, run.curves.episodes)
    played = np.diff(own, prepend=0.0) > 0
    return own[played], run.curves.success[:, played, task]


def _own_episodes(run: Run, task: int, episodes: ArrayLike) -> Values:
    practised = run.config.get("schedule", "practised") == "practised"
    return expected_own_episodes(run.starts, task, episodes, practised=practised)


def _mean_height(tests: Values, episodes: Values, curves: Values) -> Values:
    """Return the mean height of curves between the first and the last of some episodes, ``[S]``."""
    heights = np.stack([np.interp(tests, episodes, curve) for curve in curves])
    if tests[0] == tests[-1]:  # a single test
        return heights[:, -1]
    return np.trapezoid(heights, tests, axis=-1) / (tests[-1] - tests[0])
