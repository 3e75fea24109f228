"""Merge finished runs of blocks of seeds into one run directory."""

from __future__ import annotations

import csv
import io
import shlex
import sys
from collections import Counter
from collections.abc import Sequence
from itertools import chain
from pathlib import Path

from bgpo_trl.files.folders import make_folder
from bgpo_trl.files.whole_file import write_json, write_whole
from bgpo_trl.runs.cost import read_costs, total_cost, write_costs
from bgpo_trl.runs.results import read_json, read_rows


def merge(blocks: Sequence[Path], directory: Path) -> None:
    """Write the files that one run of all seeds would have written, each atomically.

    Rows are sorted by seed and episode. Losses remain means over the seeds of a block; costs are
    sums over blocks, left out if a block has none. Files about the first seed alone (``gwr.csv``
    and figures) are copied from the first block, except ``success.png`` and ``groups.png``, which
    ``summary.py`` draws.

    Args:
        blocks: Run directories that differ only in their seeds.
        directory: Folder for ``config.json``, ``train.csv``, ``eval.csv``, ``final.csv``,
            ``cost.csv`` and ``summary.json``; made if missing.

    Raises:
        ValueError: If a file is missing, or the blocks do not hold each training episode of each
            seed exactly once.
        OSError: If the directory cannot be written.
    """
    configs = [read_json(block / "config.json") for block in blocks]
    summaries = [read_json(block / "summary.json") for block in blocks]
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
            f"{directory}: its blocks do not have each episode of each seed once; remove the "
            "blocks that were changed, and run them again"
        )

    make_folder(directory)
    for name, rows in tables.items():
        text = io.StringIO()
        writer = csv.DictWriter(text, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        write_whole(directory / name, text.getvalue())
    if all((block / "cost.csv").exists() for block in blocks):
        costs = [read_costs(block / "cost.csv") for block in blocks]
        write_costs(directory / "cost.csv", total_cost(costs))
    for path in (*blocks[0].glob("gwr.csv"), *blocks[0].glob("figures/*")):
        if path.name not in ("success.png", "groups.png"):
            copy = directory / path.relative_to(blocks[0])
            write_whole(make_folder(copy.parent) / copy.name, path.read_bytes())
    summary = {
        **summaries[0],
        "commit": " ".join(dict.fromkeys(block["commit"] for block in summaries)),
        "command": shlex.join(["python", *sys.argv]),
    }
    for key in summary.keys() & {"nodes", "groups", "group_purity"}:  # a value per seed, or None
        of_blocks = [block[key] for block in summaries]
        summary[key] = None if None in of_blocks else list(chain.from_iterable(of_blocks))
    write_json(directory / "summary.json", summary)
    write_json(directory / "config.json", {**configs[0], "seeds": seeds})
