"""Merge finished runs of different seeds into one run directory."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain, combinations
from pathlib import Path
from shlex import quote
from typing import Any

import pandas as pd

from bgpo_trl.configs.runs import check_seeds
from bgpo_trl.experiments.arguments import MergeArguments
from bgpo_trl.files.writing import lock_directory, make_folder, write_json, write_whole
from bgpo_trl.runs.cost import read_costs, total_cost, write_costs
from bgpo_trl.runs.directory import differing_settings
from bgpo_trl.runs.provenance import command
from bgpo_trl.runs.results import read_json, read_table

_ENTRIES = {"seeds": list, "episodes": int}


def merge(arguments: MergeArguments) -> str:
    """Merge finished runs that differ only in their seeds, such as the jobs of a cluster.

    Writes config.json, train.csv, eval.csv, final.csv, cost.csv and summary.json as one run of all
    seeds would have. `bgpo report` reads the directory; `bgpo watch` and the tests of policies need
    one of the runs.

    Raises:
        ValueError: If there are fewer than two runs; if one is damaged or not finished; if their
            settings differ, or their seeds overlap; or if ``out`` holds another run.
        BlockingIOError: If another process is writing to ``out``.
    """
    runs, out = arguments.runs, arguments.out
    if len(runs) < 2:
        raise ValueError("name two or more runs to merge")
    for run in runs:
        if (run / "config.json").exists() and not (run / "summary.json").exists():
            raise ValueError(f"{run} is not finished: continue it with --resume, then merge")
    with lock_directory(out):
        _check_target(out, runs)
        merge_runs(runs, out)
    seeds = read_json(out / "config.json")["seeds"]
    report = f"bgpo report {quote(str(out))}"
    return f"{out}: seeds {' '.join(map(str, seeds))}; tables and figures: {report}"


def _check_target(out: Path, runs: Sequence[Path]) -> None:
    """Raise ``ValueError`` unless a directory holds no run, or an earlier result of merging."""
    if (out / "checkpoint").exists() or out.resolve() in [run.resolve() for run in runs]:
        raise ValueError(f"--out: {out} is a run of its own, name another directory")
    if not (out / "config.json").exists():
        return
    there, first = (read_json(directory / "config.json") for directory in (out, runs[0]))
    seeds = {seed for run in runs for seed in read_json(run / "config.json", _ENTRIES)["seeds"]}
    same = not differing_settings(there | {"seeds": []}, first | {"seeds": []})
    if not same or not seeds.issuperset(there.get("seeds", ())):
        raise ValueError(f"--out: {out} holds other results, name another directory")


def merge_runs(blocks: Sequence[Path], directory: Path) -> None:
    """Write the files that one run of all seeds would have written, each atomically.

    Rows are sorted by seed and episode. Costs are sums over blocks, left out if a block has none.
    Files about the first seed alone (``gwr.csv`` and figures) are copied from the first block,
    except ``success.png`` and ``groups.png``, which `bgpo_trl.experiments.report` draws.

    Args:
        blocks: Run directories that differ only in their seeds.
        directory: Folder for ``config.json``, ``train.csv``, ``eval.csv``, ``final.csv``,
            ``cost.csv`` and ``summary.json``; made if missing.

    Raises:
        ValueError: If a file is missing, a block is not finished, settings differ, seeds overlap,
            or the blocks do not hold each training episode of each seed exactly once.
        OSError: If the directory cannot be written.
    """
    configs = [read_json(block / "config.json", _ENTRIES) for block in blocks]
    summaries = [read_json(block / "summary.json", {"commit": str}) for block in blocks]
    _check_blocks(blocks, configs, summaries)
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
    episodes = configs[0]["episodes"]
    whole = len(played) == len(seeds) * episodes and played.equals(
        pd.MultiIndex.from_product([sorted(seeds), range(1, episodes + 1)])
    )
    if not whole:
        raise ValueError(
            f"{directory}: its runs do not have each episode of each seed once; remove those that "
            "were changed, and run them again"
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


def _check_blocks(
    blocks: Sequence[Path], configs: Sequence[dict[str, Any]], summaries: Sequence[dict[str, Any]]
) -> None:
    """Raise ``ValueError`` unless runs are finished and differ only in their seeds."""
    for block, config, summary in zip(blocks, configs, summaries, strict=True):
        check_seeds(config["seeds"])
        if summary.get("episodes", config["episodes"]) != config["episodes"]:
            raise ValueError(f"{block} is not finished: continue it with --resume, then merge")
    for block, config in zip(blocks[1:], configs[1:], strict=True):
        differences = differing_settings(configs[0] | {"seeds": []}, config | {"seeds": []})
        if differences:
            name, first, other = differences[0]
            raise ValueError(
                f"{blocks[0]} and {block} differ in {name} ({first} and {other}): only runs that "
                "differ in their seeds alone are merged"
            )
    for (one, ours), (other, theirs) in combinations(zip(blocks, configs, strict=True), 2):
        for seed in ours["seeds"]:
            if seed in theirs["seeds"]:
                raise ValueError(f"{one} and {other} both have seed {seed}: name one of them")


def _merged(tables: Sequence[pd.DataFrame], by: list[str]) -> pd.DataFrame:
    """Return the rows of tables of text, sorted by columns of whole numbers."""
    rows = pd.concat(tables, ignore_index=True)
    return rows.loc[rows[by].astype(int).sort_values(by, kind="stable").index]
