"""Runs in compact form, for results that are kept under version control."""

from __future__ import annotations

import gzip
from collections.abc import Mapping
from pathlib import Path

from bgpo_trl.files.writing import make_folder, write_whole
from bgpo_trl.runs.results import EVAL, TRAIN, TRAIN_COUNTS, find_table, read_json, read_table

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
