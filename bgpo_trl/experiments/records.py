"""Records of measurements on a run, and the command that made them."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

import pandas as pd

from bgpo_trl.files.writing import make_folder, write_json, write_whole


def command() -> str:
    """Return the command line of this process."""
    return shlex.join(["python", *sys.argv])


def write_measurement(
    folder: Path, name: str, columns: Sequence[str], rows: Iterable[Sequence[object]], commit: str
) -> None:
    """Write rows to ``NAME.csv``, and the commit and command of their measurement to ``NAME.json``.

    Args:
        folder: Folder of the files; made if missing.
        name: Name of the measurement.
        columns: Names of the columns.
        rows: The rows; NaN becomes an empty cell.
        commit: Result of `commit_of_code` when the measurement began.
    """
    make_folder(folder)
    write_rows(folder / f"{name}.csv", columns, rows)
    write_json(folder / f"{name}.json", {"commit": commit, "command": command()})


def write_rows(path: Path, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a CSV file; NaN becomes an empty cell."""
    table = pd.DataFrame([*rows], columns=[*columns])
    write_whole(path, table.to_csv(index=False, lineterminator="\r\n"))
