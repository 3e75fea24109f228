"""Timing of pieces of code against each other on a machine whose speed varies."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Timing:
    """Seconds that a call took: median, and the quartiles around it.

    Attributes:
        median: Of all calls (s).
        low: First quartile (s).
        high: Third quartile (s).
    """

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, seconds: Sequence[float]) -> Timing:
        """Summarizes the times of several calls (s)."""
        low, median, high = np.percentile(seconds, [25, 50, 75])
        return cls(float(median), float(low), float(high))


def interleave(
    contenders: Mapping[str, Callable[[], object]],
    *,
    rounds: int,
    warmup: int = 2,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, list[float]]:
    """Times all contenders in turn, round by round, so that they meet the same noise.

    Ratios of two contenders are best taken round by round, and then their median: see `ratio`.

    Args:
        contenders: What to time, by name; each call should take a few milliseconds at least.
        rounds: How often to call each.
        warmup: Calls of each before the first that counts.
        clock: Source of time (s).

    Returns:
        The times (s) of each contender, one for each round.
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
    """Returns the quotients of two contenders' times, round by round (no unit)."""
    pairs = zip(numerator, denominator, strict=True)
    return Timing.of([a / b for a, b in pairs])
