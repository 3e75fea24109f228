"""Run logger: writes settings and CSV files.

A run directory holds ``config.json``, ``train.csv`` and ``eval.csv`` (other modules add
``checkpoint/`` and ``figures/``). The CSV files are the record of a run: they are always
written, row by row, and a resumed run continues them byte for byte.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

from bgpo_trl.files.csv_file import CsvFile
from bgpo_trl.runs.directory import claim_directory

EVAL_COLUMNS = (
    "algorithm",
    "seed",
    "episode",
    "env_steps",
    "task",
    "success",
    "return",
    "steps",
)
"""Columns of ``eval.csv``, one row per test episode."""

TRAIN_COLUMNS = (
    *EVAL_COLUMNS,
    "intrinsic_return",
    "num_nodes",
    "group",
    "num_groups",
    "loss_actor",
    "loss_value",
)
"""Columns of ``train.csv``, one row per training episode; those of ``Algorithm.logged`` follow."""


class RunLogger:
    """Write the log of a run into its directory.

    Args:
        directory: The run directory; made if missing.
        config: Settings of the run, as JSON stores them, written to ``config.json``.
        logged: Further columns of ``train.csv``; see `Algorithm`.
        resume: Continue the run in the directory, which may have had fewer ``episodes``; call
            `truncate_to` next.

    Raises:
        ValueError: If the directory holds a run with other settings or columns, or any run without
            ``resume``; if a name in ``logged`` is that of another column.
        OSError: If the directory cannot be written.

    Examples:
        >>> import tempfile
        >>> directory = Path(tempfile.mkdtemp()) / "run"
        >>> with RunLogger(directory, config={"gamma": 0.98}) as logger:
        ...     logger.log_eval({"algorithm": "bgpo", "seed": 0, "episode": 1, "success": True})
        >>> (directory / "eval.csv").read_text().splitlines()[1]
        'bgpo,0,1,,,1,,'
    """

    def __init__(
        self,
        directory: str | os.PathLike[str],
        *,
        config: Mapping[str, Any],
        logged: Sequence[str] = (),
        resume: bool = False,
    ) -> None:
        self.directory = Path(directory)
        columns = (*TRAIN_COLUMNS, *logged)
        repeated = {name for name in logged if columns.count(name) > 1}
        if repeated:
            raise ValueError(
                f"train.csv has the column {', '.join(sorted(repeated))} already: choose other "
                "names for what the algorithm logs"
            )
        claim_directory(self.directory, config, resume=resume)
        self._train = CsvFile(self.directory / "train.csv", columns)
        self._eval = CsvFile(self.directory / "eval.csv", EVAL_COLUMNS)

    def log_train(self, row: Mapping[str, Any]) -> None:
        """Write a training episode.

        Args:
            row: Values by column of `TRAIN_COLUMNS` or ``logged``; missing ones stay empty.

        Raises:
            ValueError: If there is no such column.
            OSError: If the row cannot be written.
        """
        self._train.write(row)

    def log_eval(self, row: Mapping[str, Any]) -> None:
        """Write a test episode.

        Args:
            row: Values by column of `EVAL_COLUMNS`: names of the algorithm and the task, seed,
                training episodes and environment steps of that seed so far, and the test episode's
                success, extrinsic return and length in steps.

        Raises:
            ValueError: If there is no such column.
            OSError: If the row cannot be written.
        """
        self._eval.write(row)

    def position(self) -> dict[str, int]:
        """Flush the CSV files to disk and return their sizes, for the checkpoint."""
        return {file.path.name: file.position() for file in (self._train, self._eval)}

    def truncate_to(self, position: Mapping[str, int]) -> None:
        """Drop the rows that a resumed run will write again.

        Args:
            position: Result of `position` saved in the checkpoint; empty to start over, for a run
                that ended before its first checkpoint.

        Raises:
            ValueError: If a file is shorter.
        """
        for file in (self._train, self._eval):
            file.truncate_to(position.get(file.path.name, 0))

    def close(self) -> None:
        """Close the CSV files."""
        self._train.close()
        self._eval.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
