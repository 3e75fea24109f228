"""Success of runs, read back from their CSV files."""

from __future__ import annotations

import csv
import io
import json
import os
import re
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bgpo_trl.analysis import metrics

_CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f]")


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


def read_rows(
    path: str | os.PathLike[str],
    columns: Mapping[str, Callable[[str], object]] | None = None,
    remedy: str = "resume the run, which writes it again, or take the line out",
) -> list[dict[str, str]]:
    """Returns the rows of a CSV file of a run.

    Args:
        path: Of the file.
        columns: Those that must be there, and what raises `ValueError` for cells that cannot be.
        remedy: What to do about a damaged line.

    Raises:
        ValueError: If there is no such file, it is no CSV file, or it is not such a one.
    """
    path = Path(path)
    try:
        with path.open(newline="") as file:
            text = file.read()
            # A terminal would take these for commands.
            if _CONTROL.search(text):
                raise ValueError("control characters")
            reader = csv.DictReader(io.StringIO(text, newline=""))
            rows, found = list(reader), reader.fieldnames or ()
    except (FileNotFoundError, NotADirectoryError):
        raise ValueError(f"{path} is missing: let the run in {path.parent} finish") from None
    except (OSError, ValueError, csv.Error) as error:
        raise ValueError(f"{path} is no CSV file of a run ({error}): name another run") from None
    missing = sorted(set(columns or ()).difference(found))
    if found and missing:
        lacks = ", ".join(missing)
        raise ValueError(f"{path} is no such table of a run (it lacks {lacks}): name another run")
    for number, row in enumerate(rows, 2):
        try:
            for name, check in (columns or {}).items():
                if row[name] is None:  # a line that was cut short
                    raise ValueError
                check(row[name])
        except ValueError:
            raise ValueError(f"{path}, line {number} is damaged: {remedy}") from None
    return rows


def read_tests(path: str | os.PathLike[str]) -> list[dict[str, str]]:
    """Returns the rows of an ``eval.csv``, one a test episode.

    Raises:
        ValueError: If the file is missing or empty, or a row is not of a test episode.
    """
    columns = {"algorithm": str, "seed": count, "episode": count, "task": str, "success": _share}
    rows = read_rows(path, columns)
    if not rows:
        raise ValueError(f"{path} holds no test episode: let the run evaluate first")
    return rows


def read_final_tests(path: str | os.PathLike[str]) -> list[dict[str, str]]:
    """Returns the rows of a ``final.csv``, one a seed, task and kind of demonstrations.

    Raises:
        ValueError: If the file is missing, or a row is not of such tests.
    """
    columns = {"seed": count, "demonstrations": str, "task": str, "success": _share}
    columns["task_inference"] = _share_or_nothing  # nothing where there is no GWR-B
    return read_rows(path, columns, "remove the file and resume the run, which tests again")


def read_json(
    path: str | os.PathLike[str], entries: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Returns what a run keeps in ``config.json`` or ``summary.json``.

    Args:
        path: Of the file.
        entries: Types of those that must be there; an entry that may be None may be missing.

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
    if not isinstance(found, dict) or not all(
        isinstance(found.get(name), kind) for name, kind in (entries or {}).items()
    ):
        raise ValueError(f"{path} is damaged: put it back as the run left it, or run it again")
    return found


def count(cell: str) -> None:
    """Refuses, with a `ValueError`, what is no number of something."""
    if not 0 <= int(cell) < 2**53:
        raise ValueError


def _share(cell: str) -> None:
    if not 0 <= float(cell) <= 1:
        raise ValueError


def _share_or_nothing(cell: str) -> None:
    if cell:
        _share(cell)


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
    for row in read_rows(path, {"seed": count, "episode": count, "task": str, "success": _share}):
        if last is None or int(row["episode"]) <= last:
            outcome = int(row["episode"]), int(float(row["success"]))
            outcomes[int(row["seed"])][row["task"]].append(outcome)
    return [
        [[success for _, success in sorted(of_seed[task])] for task in tasks]
        for _, of_seed in sorted(outcomes.items())
    ]
