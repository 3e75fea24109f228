"""Time and memory of training by the number of presented tasks, in ``cost.csv``."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from bgpo_trl.files.writing import write_whole
from bgpo_trl.runs.results import COLUMNS, read_table


@dataclass
class Cost:
    """Cost of the training steps with one number of presented tasks, of all seeds together."""

    steps: int = 0
    """Training steps; in each, every seed takes one step."""
    seconds: float = 0.0
    """Wall time of these steps, without tests and checkpoints."""
    megabytes: float = 0.0
    """Size of networks, replay, GWR-B and groups after the last of these steps, in 10^6 bytes."""


class CostLog:
    """Cost of a run, kept in a file beside its checkpoints.

    Checkpoints of equal runs are equal, and times are not: hence a file of its own. It is replaced
    as a whole with each checkpoint, so a resumed run does not count repeated steps twice.

    Args:
        path: The ``cost.csv``.
        resume: Whether to continue the file, if there is one.

    Raises:
        ValueError: If the file to continue is damaged.
    """

    def __init__(self, path: str | os.PathLike[str], *, resume: bool = False) -> None:
        self.path = Path(path)
        self.costs = read_costs(self.path) if resume and self.path.exists() else {}

    def add_step(self, tasks: int, seconds: float) -> None:
        """Count a training step of ``seconds`` with so many presented ``tasks``."""
        cost = self.costs.setdefault(tasks, Cost())
        cost.steps += 1
        cost.seconds += seconds

    def measure(self, tasks: int, state: Mapping[str, Any]) -> None:
        """Note the size of the algorithm's ``state_dict`` with so many presented ``tasks``."""
        self.costs.setdefault(tasks, Cost()).megabytes = n_bytes(state) / 1e6

    def write(self) -> None:
        """Replace the file.

        Raises:
            OSError: If it cannot be written.
        """
        rows = [
            f"{tasks},{cost.steps},{cost.seconds:.3f},{cost.megabytes:.6f}"
            for tasks, cost in sorted(self.costs.items())
        ]
        write_whole(self.path, "\n".join([",".join(COLUMNS["cost.csv"]), *rows, ""]))


def n_bytes(state: Any) -> int:
    """Return the size of the tensors in nested mappings, lists and tuples."""
    if isinstance(state, Tensor):
        return state.nbytes
    if isinstance(state, Mapping):
        return sum(map(n_bytes, state.values()))
    return sum(map(n_bytes, state)) if isinstance(state, list | tuple) else 0


def read_costs(path: str | os.PathLike[str]) -> dict[int, Cost]:
    """Read a ``cost.csv``: costs by the number of presented tasks.

    Raises:
        ValueError: If the file is missing or damaged.
    """
    rows = read_table(path)[[*COLUMNS["cost.csv"]]].itertuples(index=False)
    return {int(tasks): Cost(int(steps), *amounts) for tasks, steps, *amounts in rows}
