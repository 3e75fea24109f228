"""Results of runs, read from their CSV and JSON files; and compact copies of runs.

Tables are pandas data frames. A table may be compressed, as `archive_run` writes it: where
``eval.csv`` is not there, ``eval.csv.gz`` is read.
"""

from __future__ import annotations

import gzip
import io
import json
import os
import warnings
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from bgpo_trl.files.writing import make_folder, write_whole


@dataclass(frozen=True)
class Numbers:
    """Numbers that the cells of a column may hold."""

    high: float = float(np.finfo(float).max)
    """The largest; the smallest is 0."""
    whole: bool = False
    """Whether they are integers."""
    may_be_empty: bool = False
    """Whether a cell may be empty, which is read as NaN."""


COUNT, SHARE, AMOUNT = Numbers(2**53 - 1, whole=True), Numbers(1), Numbers()
TEXT = None
"""Any text, even none."""
Cells = Numbers | Sequence[str] | None
"""The cells that a column may hold: numbers, one of some names, or any text."""

TRAIN = {"seed": COUNT, "episode": COUNT, "task": TEXT, "success": SHARE}
"""Columns of ``train.csv`` that success is computed from."""
TRAIN_COUNTS = dict.fromkeys(("num_nodes", "group", "num_groups"), COUNT)
"""Columns of ``train.csv`` on GWR-B and groups."""
EVAL = {"algorithm": TEXT, **TRAIN}
"""Columns of ``eval.csv`` that every run has."""
_FINAL = {"seed": COUNT, "demonstrations": TEXT, "task": TEXT, "success": SHARE}
_FINAL["task_inference"] = replace(SHARE, may_be_empty=True)  # of algorithms without GWR-B
_STEPS = {"steps": replace(AMOUNT, may_be_empty=True)}


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


def find_table(path: str | os.PathLike[str]) -> Path | None:
    """Return the path of a CSV file or, where it is not there, of its compressed form, if any."""
    path = Path(path)
    found = (path, path.with_name(f"{path.name}.gz"))
    return next((candidate for candidate in found if candidate.exists()), None)


def read_table(
    path: str | os.PathLike[str],
    columns: Mapping[str, Cells] | None = None,
    optional: Mapping[str, Cells] | None = None,
    remedy: str = "resume the run, which writes it again, or take the line out",
) -> pd.DataFrame:
    """Return a CSV file of a run, plain or compressed.

    Args:
        path: The CSV file; where it is not there, ``path`` with ``.gz`` is read.
        columns: Required columns and what their cells may hold. Other columns are kept as text.
        optional: Further columns; those that the file lacks are NaN.
        remedy: Advice for a damaged line, the end of the error message.

    Raises:
        ValueError: If the file is missing or not CSV, lacks a column or has an invalid cell.
    """
    path, columns, optional = find_table(path) or Path(path), dict(columns or {}), optional or {}
    table = _read_text(path)
    missing = sorted(set(columns).difference(table.columns))
    if len(table.columns) and missing:
        raise ValueError(f"{path} lacks the columns {', '.join(missing)}: name another run")
    if missing:
        return pd.DataFrame(columns=pd.Index([*columns, *optional]))
    columns |= {name: cells for name, cells in optional.items() if name in table}
    damaged = pd.Series(False, index=table.index)
    for name, cells in columns.items():
        if isinstance(cells, Numbers):
            table[name], valid = _numbers(table[name], cells)
            damaged |= ~valid
        elif cells is not None:
            damaged |= ~table[name].isin(list(cells))
    if damaged.any():
        line = 2 + int(damaged.to_numpy().argmax())
        raise ValueError(f"{path}, line {line} is damaged: {remedy}")
    whole = [n for n, cells in columns.items() if isinstance(cells, Numbers) and cells.whole]
    lacking = {name: np.nan for name in optional if name not in table}
    return table.astype(dict.fromkeys(whole, np.int64)).assign(**lacking)


def _read_text(path: Path) -> pd.DataFrame:
    """Return the cells of a CSV file as text."""
    try:
        content = path.read_bytes()
        text = (gzip.decompress(content) if path.suffix == ".gz" else content).decode()
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)  # a line that is too long
            return pd.read_csv(
                io.StringIO(text),
                dtype=str,
                na_values=[],
                keep_default_na=False,
                index_col=False,
                skip_blank_lines=True,
            )
    except (FileNotFoundError, NotADirectoryError):
        raise _missing(path) from None
    except pd.errors.EmptyDataError:
        return pd.DataFrame()
    except (OSError, EOFError, zlib.error, ValueError, pd.errors.ParserWarning) as error:
        raise ValueError(
            f"{path} is not a CSV file of a run ({str(error).splitlines()[0]}): name another run"
        ) from None


def _numbers(cells: pd.Series, kind: Numbers) -> tuple[pd.Series, pd.Series]:
    """Return the numbers in cells, NaN where there is none, and whether each is valid."""
    numbers = pd.to_numeric(cells, errors="coerce").astype(float)
    valid = numbers.between(0, kind.high)
    if kind.whole:
        valid &= numbers % 1 == 0
    if kind.may_be_empty:
        valid |= cells == ""
    return numbers, valid


def _missing(path: Path) -> ValueError:
    if not path.parent.exists():
        return ValueError(f"there is no run at {path.parent}: name another")
    return ValueError(f"{path} is missing: let the run in {path.parent} finish")


def read_tests(path: str | os.PathLike[str]) -> pd.DataFrame:
    """Return an ``eval.csv``, one row per test episode.

    ``steps`` is NaN if it is not stored.

    Raises:
        ValueError: If the file is missing or empty, or a row is invalid.
    """
    table = read_table(path, EVAL, _STEPS)
    if table.empty:
        raise ValueError(f"{path} holds no test episode: let the run evaluate first")
    return table


def read_final_tests(path: str | os.PathLike[str]) -> pd.DataFrame:
    """Return a ``final.csv``, one row per seed, task and kind of demonstrations.

    ``task_inference`` is NaN for algorithms without GWR-B. ``steps``, those of a success, is NaN
    without one, and if it is not stored.

    Raises:
        ValueError: If the file is missing, or a row is invalid.
    """
    remedy = "remove the file and resume the run, which tests again"
    return read_table(path, _FINAL, _STEPS, remedy)


class RepeatedKeyError(ValueError):
    """A file of settings gives a key twice; without the error, the last value would count."""

    def __init__(self, where: object, key: str) -> None:
        super().__init__(f"{where} gives {key!r} twice: keep one of the two")


def parse_json(path: Path) -> Any:
    """Return the content of a JSON file.

    Raises:
        RepeatedKeyError: If an object of it gives a key twice.
        ValueError: If it is not JSON.
        OSError: If it cannot be read.
    """

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        found = dict[str, Any]()
        for key, value in pairs:
            if key in found:
                raise RepeatedKeyError(path, key)
            found[key] = value
        return found

    return json.loads(path.read_text(), object_pairs_hook=unique)


def read_json(
    path: str | os.PathLike[str], entries: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Return the content of a run's ``config.json`` or ``summary.json``.

    Args:
        path: The JSON file.
        entries: Types of the required entries; an entry that may be ``None`` may be missing.

    Raises:
        ValueError: If the file is missing or damaged, or gives a key twice.
    """
    path = Path(path)
    try:
        found = parse_json(path)
    except (FileNotFoundError, NotADirectoryError):
        raise _missing(path) from None
    except RepeatedKeyError:
        raise
    except (OSError, ValueError, RecursionError):
        found = None
    if not isinstance(found, dict) or not all(
        isinstance(found.get(name), kind) for name, kind in (entries or {}).items()
    ):
        raise ValueError(f"{path} is damaged: put it back as the run left it, or run it again")
    return found


def read_curves(path: str | os.PathLike[str], tasks: Sequence[str]) -> Curves:
    """Read the test success of one run.

    Args:
        path: The ``eval.csv`` of the run.
        tasks: Task names, in the order of the curves.

    Raises:
        ValueError: If the file is missing or empty, or tests another task.
    """
    tests = read_tests(path)
    unknown = sorted(set(tests["task"]) - set(tasks))
    if unknown:
        raise ValueError(f"{path} tests {unknown[0]!r}, which is none of {', '.join(tasks)}")
    means = tests.groupby(["seed", "episode", "task"])["success"].mean()
    seeds, episodes = (sorted(set(tests[name])) for name in ("seed", "episode"))
    every = pd.MultiIndex.from_product([seeds, episodes, list(tasks)])
    success = means.reindex(every).to_numpy().reshape(len(seeds), len(episodes), len(tasks))
    return Curves(tuple(map(int, seeds)), tuple(tasks), np.array(episodes), success)


_WHOLE = ("summary.json", "final.csv", "cost.csv")
# Columns that reports and figures read; None for all.
_TABLES: Mapping[str, tuple[str, ...] | None] = {
    "train.csv": (*TRAIN, *TRAIN_COUNTS),
    "eval.csv": (*EVAL, "steps"),
    "gwr.csv": None,
}


def archive_run(run: Path, target: Path) -> None:
    """Copy what reports and figures read of a finished run.

    Settings, summary, final tests and cost are copied as they are. Of ``train.csv``, ``eval.csv``
    and ``gwr.csv``, the columns that are read are written as gzip. The same run always gives the
    same bytes, and an archived run can be archived again.

    Args:
        run: The run directory.
        target: Directory of the copy; made if missing.

    Raises:
        ValueError: If a file of the run is missing or damaged, or ``target`` is the run, or holds
            another one.
        OSError: If the copy cannot be written.
    """
    if run.resolve() == target.resolve():
        raise ValueError(f"{target} is the run itself: name another folder for the copy")
    config = read_json(run / "config.json")
    if (target / "config.json").exists() and read_json(target / "config.json") != config:
        raise ValueError(f"{target} holds another run: name another folder for the copy")
    content = {"config.json": (run / "config.json").read_bytes()}
    content |= {name: (run / name).read_bytes() for name in _WHOLE if (run / name).exists()}
    for name, columns in _TABLES.items():
        if name == "eval.csv" or find_table(run / name):
            table = read_table(run / name)
            kept = [column for column in table.columns if columns is None or column in columns]
            text = table[kept].to_csv(index=False, lineterminator="\n")
            content[f"{name}.gz"] = gzip.compress(text.encode(), mtime=0)
    make_folder(target)
    for name, data in content.items():
        write_whole(target / name, data)
