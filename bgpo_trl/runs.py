"""Test success of runs, read back from their CSV files."""

from __future__ import annotations

import csv
import os
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Curves:
    """Test success of one run over its training.

    Attributes:
        seeds: ``S`` of them, in increasing order.
        tasks: ``T`` names.
        episodes: Training episodes before each evaluation, increasing, ``[E]``.
        success: Share of successes in a seed's test episodes of a task, ``[S, E, T]``; NaN where
            there was no test, which is what tasks not yet presented have.
    """

    seeds: tuple[int, ...]
    tasks: tuple[str, ...]
    episodes: NDArray[np.int64]
    success: NDArray[np.float64]

    def until(self, episode: int) -> Curves:
        """Returns the evaluations after at most so many training episodes."""
        kept = self.episodes <= episode
        return replace(self, episodes=self.episodes[kept], success=self.success[:, kept])


def read_rows(path: str | os.PathLike[str]) -> list[dict[str, str]]:
    """Returns the rows of a CSV file of a run.

    Raises:
        ValueError: If there is no such file.
    """
    path = Path(path)
    try:
        with path.open(newline="") as file:
            return list(csv.DictReader(file))
    except FileNotFoundError:
        raise ValueError(f"{path} is missing: let the run in {path.parent} finish") from None


def read_curves(path: str | os.PathLike[str], tasks: Sequence[str]) -> Curves:
    """Reads an ``eval.csv``.

    Args:
        path: Of the file of one run.
        tasks: Names of the tasks, in the order of the curves.

    Raises:
        ValueError: If the file is missing or empty, or a test is of another task.
    """
    tests: dict[tuple[int, int, str], list[float]] = defaultdict(list)
    for row in read_rows(path):
        key = (int(row["seed"]), int(row["episode"]), row["task"])
        tests[key].append(float(row["success"]))
    if not tests:
        raise ValueError(f"{path} holds no test episode: let the run evaluate first")
    unknown = sorted({task for _, _, task in tests} - set(tasks))
    if unknown:
        raise ValueError(f"{path} tests {unknown[0]!r}, which is none of {', '.join(tasks)}")
    seeds = sorted({seed for seed, _, _ in tests})
    episodes = sorted({episode for _, episode, _ in tests})
    success = np.full((len(seeds), len(episodes), len(tasks)), np.nan)
    for (seed, episode, task), successes in tests.items():
        where = seeds.index(seed), episodes.index(episode), tasks.index(task)
        success[where] = np.mean(successes)
    return Curves(tuple(seeds), tuple(tasks), np.array(episodes), success)
