"""Where results come from: code, versions and command; and tables."""

from __future__ import annotations

import importlib.metadata
import shlex
import subprocess
import sys
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import pandas as pd

from bgpo_trl.files.writing import without_folders, write_whole


@cache
def commit_of_code() -> str:
    """Return the commit of this code, with ``-dirty`` if it was modified; ``""`` if unknown.

    The first call decides, since commits may follow while a process trains.
    """
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
    """Return the command line of this process, `without_folders` of this machine."""
    return without_folders(shlex.join(["python", *sys.argv]))


def write_table(path: Path, table: pd.DataFrame) -> None:
    """Write a CSV file; NaN becomes an empty cell."""
    write_whole(path, table.to_csv(index=False, lineterminator="\r\n"))


def each_once(texts: Iterable[str]) -> str:
    """Return each text once, in order, joined by ``"; "``, without empty ones."""
    return "; ".join(filter(None, dict.fromkeys(texts)))
