"""Where results come from: code, versions and command; and files of measurements with these."""

from __future__ import annotations

import importlib.metadata
import shlex
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

import pandas as pd

from bgpo_trl.files.writing import make_folder, write_json, write_whole


def commit_of_code() -> str:
    """Return the commit of this code, with ``-dirty`` if it was modified; ``""`` if unknown."""
    root = Path(__file__).parents[2]
    if not (root / ".git").exists():  # An installed package may lie in another repository.
        return ""
    describe = ["git", "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
    try:
        result = subprocess.run(describe, cwd=root, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return ""
    return result.stdout.strip()


def versions() -> dict[str, str]:
    """Return the installed versions of the packages that a run depends on most."""
    packages = ("bgpo_trl", "torch", "torchrl", "mujoco")
    return {package: importlib.metadata.version(package) for package in packages}


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
