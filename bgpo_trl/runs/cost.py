"""Time and memory of training by the number of presented tasks, in ``cost.csv``."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
from torch import Tensor

from bgpo_trl.files.writing import write_whole
from bgpo_trl.runs.results import COLUMNS, read_table


class CostLog:
    """Cost of a run, kept in a file beside its checkpoints; ``resume`` continues it if it is there.

    Checkpoints of equal runs are equal, and times are not: hence a file of its own. It is replaced
    as a whole with each checkpoint, so a resumed run does not count repeated steps twice.

    Raises:
        ValueError: If the file to continue is damaged.
    """

    def __init__(self, path: str | os.PathLike[str], *, resume: bool = False) -> None:
        self._path = Path(path)
        table = read_table(self._path) if resume and self._path.exists() else pd.DataFrame()
        # Training steps of all seeds, their seconds, and megabytes after the last of them.
        self._costs = {int(tasks): costs for tasks, *costs in table.itertuples(index=False)}

    def add_step(self, tasks: int, seconds: float) -> None:
        """Count a training step of ``seconds`` with so many presented ``tasks``."""
        costs = self._costs.setdefault(tasks, [0, 0.0, 0.0])
        costs[0] += 1
        costs[1] += seconds

    def measure(self, tasks: int, state: Mapping[str, Any]) -> None:
        """Note the size of the algorithm's ``state_dict`` with so many presented ``tasks``."""
        self._costs.setdefault(tasks, [0, 0.0, 0.0])[2] = n_bytes(state) / 1e6

    def write(self) -> None:
        """Replace the file; raise ``OSError`` if it cannot be written."""
        rows = [
            (tasks, steps, f"{seconds:.3f}", f"{megabytes:.6f}")
            for tasks, (steps, seconds, megabytes) in sorted(self._costs.items())
        ]
        table = pd.DataFrame(rows, columns=pd.Index(COLUMNS["cost.csv"]))
        write_whole(self._path, table.to_csv(index=False))


def n_bytes(state: Any) -> int:
    """Return the size of the tensors in nested mappings, lists and tuples."""
    if isinstance(state, Tensor):
        return state.nbytes
    if isinstance(state, Mapping):
        return sum(map(n_bytes, state.values()))
    return sum(map(n_bytes, state)) if isinstance(state, list | tuple) else 0
