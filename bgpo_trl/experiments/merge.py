"""Makes one run directory of the finished runs of blocks of its seeds."""

from __future__ import annotations

import csv
import io
import json
import shlex
import sys
from collections import Counter
from collections.abc import Sequence
from itertools import chain
from pathlib import Path

from bgpo_trl.runs.results import read_json, read_rows


def merge(blocks: Sequence[Path], directory: Path) -> None:
    """Writes what one run of all seeds would have, each file whole or not at all.

    Rows are sorted by seed and episode. Losses stay means over the seeds of a block. What is of the
    first seed alone, ``gwr.csv`` and figures, is the first block's; ``success.png`` and
    ``groups.png`` are left to ``summary.py``.

    Args:
        blocks: Run directories, which differ by their seeds alone.
        directory: Where ``config.json``, ``train.csv``, ``eval.csv``, ``final.csv`` and
            ``summary.json`` go; made if it does not exist.

    Raises:
        ValueError: If a file is missing, or the blocks do not have each training episode of each
            seed once.
        OSError: If the directory cannot be written.
    """
    configs = [read_json(block / "config.json") for block in blocks]
    told = [read_json(block / "summary.json") for block in blocks]
    seeds = [seed for config in configs for seed in config["seeds"]]
    tables = {
        name: sorted(
            (row for block in blocks for row in read_rows(block / name)),
            key=lambda row: (int(row["seed"]), int(row.get("episode", 0))),
        )
        for name in ("train.csv", "eval.csv", "final.csv")
    }
    played = Counter((int(row["seed"]), int(row["episode"])) for row in tables["train.csv"])
    episodes = range(1, configs[0]["episodes"] + 1)
    if played != Counter((seed, episode) for seed in seeds for episode in episodes):
        raise ValueError(
            f"{directory}: its blocks do not have each episode of each seed once; remove those "
            "that were changed, and play them again"
        )

    directory.mkdir(parents=True, exist_ok=True)
    for name, rows in tables.items():
        text = io.StringIO()
        writer = csv.DictWriter(text, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        _write(directory / name, text.getvalue().encode())
    for path in (*blocks[0].glob("gwr.csv"), *blocks[0].glob("figures/*")):
        if path.name not in ("success.png", "groups.png"):
            _write(directory / path.relative_to(blocks[0]), path.read_bytes())
    summary = {
        **told[0],
        "commit": " ".join(dict.fromkeys(block["commit"] for block in told)),
        "command": shlex.join(["python", *sys.argv]),
    }
    for key in summary.keys() & {"nodes", "groups", "group_purity"}:  # one of each seed, or none
        of_blocks = [block[key] for block in told]
        summary[key] = None if None in of_blocks else list(chain.from_iterable(of_blocks))
    _write_json(directory / "summary.json", summary)
    _write_json(directory / "config.json", {**configs[0], "seeds": seeds})


def _write_json(path: Path, content: dict) -> None:
    _write(path, (json.dumps(content, indent=2) + "\n").encode())


def _write(path: Path, content: bytes) -> None:
    path.parent.mkdir(exist_ok=True)
    temporary = path.with_name(f"{path.name}.tmp")
    temporary.write_bytes(content)
    temporary.replace(path)
