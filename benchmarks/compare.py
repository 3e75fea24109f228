"""Permutation test of the difference between two runs.

    python benchmarks/compare.py runs/before runs/after

prints, for each task and part of training, the test success of both runs and the two-sided p
value of an exact permutation test over seeds: the share of all assignments of the seeds to the two
runs whose means differ at least as much. With five seeds per run, the smallest possible p is
2 / 252.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from bgpo_trl.runs.results import read_tests


@dataclass(frozen=True)
class Arguments:
    """Compare the ``eval.csv`` of two runs."""

    first: tyro.conf.Positional[Path]
    """Directory of the first run."""
    second: tyro.conf.Positional[Path]
    """Directory of the second run."""
    every: int = 1_000
    """Training episodes per row of the table."""


def success_by_seed(
    path: Path, every: int, last: int | None = None
) -> dict[tuple[str, int], np.ndarray]:
    """Return the mean success of each seed ``[S]``, by task and last episode of a part of training.

    Args:
        path: An ``eval.csv``.
        every: Length of a part in training episodes.
        last: Last training episode to read.
    """
    found: dict[tuple[str, int], dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for row in read_tests(path):
        if last is not None and int(row["episode"]) > last:
            continue
        end = -(-int(row["episode"]) // every) * every
        found[row["task"], end][row["seed"]].append(float(row["success"]))
    return {key: np.array([np.mean(s) for s in seeds.values()]) for key, seeds in found.items()}


def permutation_p(first: np.ndarray, second: np.ndarray) -> float:
    """Return the two-sided p value of the difference of two means, over all permutations.

    Args:
        first: Sample ``[A]``.
        second: Sample ``[B]``.
    """
    everything = np.concatenate([first, second])
    observed = abs(first.mean() - second.mean())
    drawn = np.array(
        [
            abs(everything[list(own)].mean() - np.delete(everything, own).mean())
            for own in combinations(range(len(everything)), len(first))
        ]
    )
    return float((drawn >= observed - 1e-12).mean())


def main(arguments: Arguments) -> None:
    """Print the table."""
    if arguments.every < 1:
        raise ValueError(f"--every must be at least 1 episode, got {arguments.every}")
    paths = arguments.first / "eval.csv", arguments.second / "eval.csv"
    # If one run is shorter, only the part that both have is compared.
    last = min(max(int(row["episode"]) for row in read_tests(path)) for path in paths)
    first, second = (success_by_seed(path, arguments.every, last) for path in paths)
    shared = sorted(first.keys() & second.keys())
    if not shared:
        raise ValueError("the runs share no task and part of training: nothing to compare")
    print("| task | episodes up to | first | second | difference | p |")
    print("|---|---:|---:|---:|---:|---:|")
    for task, end in shared:
        a, b = first[task, end], second[task, end]
        print(
            f"| {task} | {end} | {a.mean():.2f} | {b.mean():.2f} | {b.mean() - a.mean():+.2f} "
            f"| {permutation_p(a, b):.2f} |"
        )


if __name__ == "__main__":
    try:
        main(tyro.cli(Annotated[Arguments, tyro.conf.OmitArgPrefixes], description=__doc__))
    except (ValueError, OSError) as error:
        sys.exit(f"error: {error}")
