"""Results of runs, read from their CSV and JSON files."""

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

_CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f]")


@dataclass(frozen=True)
class Curves:
    """Test success of one run over its training.

    Attributes:
        seeds: The ``S`` seeds, in increasing order.
        tasks: The ``T`` task names.
        episodes: Training episodes before each evaluation, increasing, ``[E]``.
        success: Share of successes among a seed's test episodes of a task, ``[S, E, T]``; NaN
            where a task was not tested because it had not been presented yet.
    """

    seeds: tuple[int, ...]
    tasks: tuple[str, ...]
    episodes: NDArray[np.int64]
    success: NDArray[np.float64]

    def until(self, episode: int) -> Curves:
        """Return the evaluations after at most ``episode`` training episodes."""
        kept = self.episodes <= episode
        return replace(self, episodes=self.episodes[kept], success=self.success[:, kept])


def read_rows(
    path: str | os.PathLike[str],
    columns: Mapping[str, Callable[[str], object]] | None = None,
    remedy: str = "resume the run, which writes it again, or take the line out",
) -> list[dict[str, str]]:
    """Return the rows of a CSV file of a run.

    Args:
        path: The CSV file.
        columns: Required columns, each with a function that raises ``ValueError`` for invalid
            cells.
        remedy: Advice for a damaged line, the end of the error message.

    Raises:
        ValueError: If the file is missing or not CSV, lacks a column or has an invalid cell.
    """
    path = Path(path)
    try:
        with path.open(newline="") as file:
            text = file.read()
            # Error messages quote the file, and a terminal would execute these as commands.
            if _CONTROL.search(text):
                raise ValueError("control characters")
            reader = csv.DictReader(io.StringIO(text, newline=""))
            rows, header = list(reader), reader.fieldnames or ()
    except (FileNotFoundError, NotADirectoryError):
        raise _missing(path) from None
    except (OSError, ValueError, csv.Error) as error:
        raise ValueError(f"{path} is not a CSV file of a run ({error}): name another run") from None
    missing = sorted(set(columns or ()).difference(header))
    if header and missing:
        raise ValueError(f"{path} lacks the columns {', '.join(missing)}: name another run")
    for number, row in enumerate(rows, 2):
        try:
            for name, check in (columns or {}).items():
                if row[name] is None:  # a line that was cut short
                    raise ValueError
                check(row[name])
        except ValueError:
            raise ValueError(f"{path}, line {number} is damaged: {remedy}") from None
    return rows


def _missing(path: Path) -> ValueError:
    if not path.parent.exists():
        return ValueError(f"there is no run at {path.parent}: name another")
    return ValueError(f"{path} is missing: let the run in {path.parent} finish")


def read_tests(path: str | os.PathLike[str]) -> list[dict[str, str]]:
    """Return the rows of an ``eval.csv``, one per test episode.

    Raises:
        ValueError: If the file is missing or empty, or a row is invalid.
    """
    columns = {"algorithm": str, "seed": count, "episode": count, "task": str, "success": _share}
    rows = read_rows(path, columns)
    if not rows:
        raise ValueError(f"{path} holds no test episode: let the run evaluate first")
    return rows


def read_final_tests(path: str | os.PathLike[str]) -> list[dict[str, str]]:
    """Return the rows of a ``final.csv``, one per seed, task and kind of demonstrations.

    Raises:
        ValueError: If the file is missing, or a row is invalid.
    """
    columns = {"seed": count, "demonstrations": str, "task": str, "success": _share}
    columns["task_inference"] = _share_or_nothing  # empty for algorithms without GWR-B
    return read_rows(path, columns, "remove the file and resume the run, which tests again")


def read_json(
    path: str | os.PathLike[str], entries: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Return the content of a run's ``config.json`` or ``summary.json``.

    Args:
        path: The JSON file.
        entries: Types of the required entries; an entry that may be ``None`` may be missing.

    Raises:
        ValueError: If the file is missing or damaged.
    """
    path = Path(path)
    try:
        found = json.loads(path.read_text())
    except (FileNotFoundError, NotADirectoryError):
        raise _missing(path) from None
    except (OSError, ValueError, RecursionError):
        found = None
    if not isinstance(found, dict) or not all(
        isinstance(found.get(name), kind) for name, kind in (entries or {}).items()
    ):
        raise ValueError(f"{path} is damaged: put it back as the run left it, or run it again")
    return found


def count(cell: str) -> None:
    """Raise ``ValueError`` unless a cell is a non-negative integer below 2^53."""
    if not 0 <= int(cell) < 2**53:
        raise ValueError


def _share(cell: str) -> None:
    if not 0 <= float(cell) <= 1:
        raise ValueError


def _share_or_nothing(cell: str) -> None:
    if cell:
        _share(cell)


def read_curves(path: str | os.PathLike[str], tasks: Sequence[str]) -> Curves:
    """Read the test success of one run.

    Args:
        path: The ``eval.csv`` of the run.
        tasks: Task names, in the order of the curves.

    Raises:
        ValueError: If the file is missing or empty, or tests another task.
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
    """Read the outcomes of each task's training episodes.

    Args:
        path: The ``train.csv`` of the run.
        tasks: Task names.
        last: Last training episode to include; ``None`` for all.

    Returns:
        For each seed, in increasing order, and each task: 1 (success) or 0 for each of its
        training episodes, in order.

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
