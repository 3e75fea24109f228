"""Timing of contenders against each other on a machine whose speed varies."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Timing:
    """Median and quartiles of the times of a call.

    Attributes:
        median: Median (s).
        low: First quartile (s).
        high: Third quartile (s).
    """

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, seconds: Sequence[float]) -> Timing:
        """Summarize the times of several calls (s)."""
        low, median, high = np.percentile(seconds, [25, 50, 75])
        return cls(float(median), float(low), float(high))


def interleave(
    contenders: Mapping[str, Callable[[], object]],
    *,
    rounds: int,
    warmup: int = 2,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, list[float]]:
    """Time all contenders in turn, round by round, so that they share the same noise.

    Compare two contenders by the median of their ratios round by round: see `ratio`.

    Args:
        contenders: Calls to time, by name; each should take a few milliseconds or more.
        rounds: Number of timed calls of each.
        warmup: Number of untimed calls of each before.
        clock: Source of time (s).

    Returns:
        The times (s) of each contender, one per round.
    """
    for _ in range(warmup):
        for call in contenders.values():
            call()
    times: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(rounds):
        for name, call in contenders.items():
            start = clock()
            call()
            times[name].append(clock() - start)
    return times


def ratio(numerator: Sequence[float], denominator: Sequence[float]) -> Timing:
    """Return the round-by-round ratios of two contenders' times (no unit)."""
    pairs = zip(numerator, denominator, strict=True)
    return Timing.of([a / b for a, b in pairs])
