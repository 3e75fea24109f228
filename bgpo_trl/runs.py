"""Success of runs, read back from their CSV files."""

from __future__ import annotations

import csv
import json
import os
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bgpo_trl import metrics


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

    def episodes_to(self, threshold: float = 0.8) -> float:
        """Returns when success overall first reaches a rate; infinite if it never does.

        That is the mean over seeds and the tasks presented, and over the last three evaluations: a
        single one has few test episodes.
        """
        presented = metrics.presented_mean(metrics.trailing_mean(self.success, 3))
        return float(metrics.episodes_to(presented.mean(axis=0), self.episodes, threshold))


def read_rows(path: str | os.PathLike[str]) -> list[dict[str, str]]:
    """Returns the rows of a CSV file of a run.

    Raises:
        ValueError: If there is no such file, or it is no CSV file.
    """
    return _read_csv(path)[1]


def _read_csv(path: str | os.PathLike[str]) -> tuple[Sequence[str], list[dict[str, str]]]:
    path = Path(path)
    try:
        with path.open(newline="") as file:
            reader = csv.DictReader(file)
            rows = list(reader)
            return reader.fieldnames or (), rows
    except (FileNotFoundError, NotADirectoryError):
        raise ValueError(f"{path} is missing: let the run in {path.parent} finish") from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path} is no CSV file of a run ({error}): name another run") from None


def read_tests(path: str | os.PathLike[str]) -> list[dict[str, str]]:
    """Returns the rows of an ``eval.csv``, one a test episode.

    Raises:
        ValueError: If the file is missing or empty, or a row is not of a test episode.
    """
    columns, rows = _read_csv(path)
    missing = sorted({"algorithm", "seed", "episode", "task", "success"}.difference(columns))
    if columns and missing:
        raise ValueError(f"{path} is no eval.csv of a run: it lacks {', '.join(missing)}")
    if not rows:
        raise ValueError(f"{path} holds no test episode: let the run evaluate first")
    for number, row in enumerate(rows, 2):
        try:
            _ = int(row["seed"]), int(row["episode"]), float(row["success"])
        except (TypeError, ValueError):
            raise ValueError(
                f"{path}, line {number} is damaged: resume the run, which writes it again, or take "
                "the line out"
            ) from None
    return rows


def read_json(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Returns what a run keeps in ``config.json`` or ``summary.json``.

    Raises:
        ValueError: If there is no such file, or it is damaged.
    """
    path = Path(path)
    try:
        found = json.loads(path.read_text())
    except (FileNotFoundError, NotADirectoryError):
        raise ValueError(f"{path} is missing: let the run in {path.parent} finish") from None
    except (OSError, ValueError, RecursionError):
        found = None
    if not isinstance(found, dict):
        raise ValueError(f"{path} is damaged: put it back as the run left it, or run it again")
    return found


def read_curves(path: str | os.PathLike[str], tasks: Sequence[str]) -> Curves:
    """Reads an ``eval.csv``.

    Args:
        path: Of the file of one run.
        tasks: Names of the tasks, in the order of the curves.

    Raises:
        ValueError: If the file is missing or empty, or a test is of another task.
    """
    tests: dict[tuple[int, int, str], list[float]] = defaultdict(list)
    for row in read_tests(path):
        key = (int(row["seed"]), int(row["episode"]), row["task"])
        tests[key].append(float(row["success"]))
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


def read_outcomes(
    path: str | os.PathLike[str], tasks: Sequence[str], last: int | None = None
) -> list[list[list[int]]]:
    """Reads from a ``train.csv`` how each task's own training episodes went.

    Args:
        path: Of the file of one run.
        tasks: Names of the tasks.
        last: Training episode after which episodes are left out; none is if None.

    Returns:
        For each seed, in increasing order, and each task: 1 for an episode that succeeded and 0 for
        one that did not, in the order of training.

    Raises:
        ValueError: If the file is missing or damaged.
    """
    outcomes: dict[int, dict[str, list[tuple[int, int]]]] = defaultdict(lambda: defaultdict(list))
    for number, row in enumerate(read_rows(path), 2):
        try:
            seed, episode, task = int(row["seed"]), int(row["episode"]), row["task"]
            outcome = (episode, int(float(row["success"])))
        except (KeyError, TypeError, ValueError):
            raise ValueError(f"{path}, line {number} is damaged: take the line out") from None
        if last is None or episode <= last:
            outcomes[seed][task].append(outcome)
    return [
        [[success for _, success in sorted(of_seed[task])] for task in tasks]
        for _, of_seed in sorted(outcomes.items())
    ]
