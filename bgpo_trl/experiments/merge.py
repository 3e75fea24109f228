"""Merge finished runs of blocks of seeds into one run directory."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from pathlib import Path

import pandas as pd

from bgpo_trl.experiments.records import command
from bgpo_trl.files.writing import make_folder, write_json, write_whole
from bgpo_trl.runs.cost import read_costs, total_cost, write_costs
from bgpo_trl.runs.results import read_json, read_table


def merge(blocks: Sequence[Path], directory: Path) -> None:
    """Write the files that one run of all seeds would have written, each atomically.

    Rows are sorted by seed and episode. Losses remain means over the seeds of a block; costs are
    sums over blocks, left out if a block has none. Files about the first seed alone (``gwr.csv``
    and figures) are copied from the first block, except ``success.png`` and ``groups.png``, which
    `bgpo_trl.experiments.report` draws.

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
        name: _merged([read_table(block / name) for block in blocks], by)
        for name, by in (
            ("train.csv", ["seed", "episode"]),
            ("eval.csv", ["seed", "episode"]),
            ("final.csv", ["seed"]),
        )
    }
    played = pd.MultiIndex.from_frame(tables["train.csv"][["seed", "episode"]].astype(int))
    episodes = range(1, configs[0]["episodes"] + 1)
    if not played.equals(pd.MultiIndex.from_product([sorted(seeds), episodes])):
        raise ValueError(
            f"{directory}: its blocks do not have each episode of each seed once; remove the "
            "blocks that were changed, and run them again"
        )

    make_folder(directory)
    for name, table in tables.items():
        write_whole(directory / name, table.to_csv(index=False, lineterminator="\n"))
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
        "command": command(),
    }
    for key in summary.keys() & {"nodes", "groups", "group_purity"}:  # a value per seed, or None
        of_blocks = [block[key] for block in summaries]
        summary[key] = None if None in of_blocks else list(chain.from_iterable(of_blocks))
    write_json(directory / "summary.json", summary)
    write_json(directory / "config.json", {**configs[0], "seeds": seeds})


def _merged(tables: Sequence[pd.DataFrame], by: list[str]) -> pd.DataFrame:
    """Return the rows of tables of text, sorted by columns of whole numbers."""
    rows = pd.concat(tables, ignore_index=True)
    return rows.loc[rows[by].astype(int).sort_values(by, kind="stable").index]
