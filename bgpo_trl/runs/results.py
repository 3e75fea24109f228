"""Runs read back from their directories, the columns of their tables, and compact copies of runs.

Tables are pandas data frames. A table may be compressed, as `archive_run` writes it: where
``eval.csv`` is not there, ``eval.csv.gz`` is read.
"""

from __future__ import annotations

import gzip
import json
import os
import warnings
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from bgpo_trl.files.writing import make_folder, write_whole

_EPISODE = ("algorithm", "seed", "episode", "env_steps", "task", "success", "return", "steps")
_OF_TRAINING = ("intrinsic_return", "num_nodes", "group", "num_groups", "loss_actor", "loss_value")
COLUMNS: Mapping[str, tuple[str, ...]] = {
    "train.csv": (*_EPISODE, *_OF_TRAINING),
    "eval.csv": _EPISODE,
    "final.csv": (
        *("seed", "demonstrations", "task", "episodes", "success", "steps", "task_inference"),
    ),
    "cost.csv": ("tasks", "steps", "seconds", "megabytes"),
}
"""Columns of the tables of a run, as they are written.

A row is a training episode in ``train.csv``, where the columns of ``Algorithm.logged`` follow, and
a test episode in ``eval.csv``. It is a seed, a kind of demonstrations and a task in ``final.csv``,
where ``steps`` is the mean length of the successful tests; ``task_inference`` is empty for
algorithms without GWR-B. It is a number of presented tasks in ``cost.csv``."""
_READ: Mapping[str, tuple[str, ...]] = {
    "train.csv": ("seed", "episode", "task", "success", "num_nodes", "group", "num_groups"),
    "eval.csv": ("algorithm", "seed", "episode", "task", "success", "steps"),
    "final.csv": ("seed", "demonstrations", "task", "success", "steps", "task_inference"),
    "cost.csv": COLUMNS["cost.csv"],
}
"""Columns that reports and figures read; those of ``_OPTIONAL`` may be missing or empty."""
_OPTIONAL = ("steps", "task_inference", "num_nodes", "group", "num_groups")
_TEXT = ("algorithm", "task", "demonstrations")
_WHOLE = ("seed", "episode", "tasks", "num_nodes", "group", "num_groups")
_SHARES = ("success", "task_inference")


def find_table(path: str | os.PathLike[str]) -> Path | None:
    """Return the path of a CSV file or, where it is not there, of its compressed form, if any."""
    path = Path(path)
    found = (path, path.with_name(f"{path.name}.gz"))
    return next((candidate for candidate in found if candidate.exists()), None)


def read_table(path: str | os.PathLike[str]) -> pd.DataFrame:
    """Return a CSV file of a run, plain or compressed.

    Raises:
        ValueError: If the file is missing or not CSV, lacks a column that reports read, or has an
            invalid cell in one.
    """
    path = find_table(path) or Path(path)
    read = _READ.get(path.name.removesuffix(".gz"), ())
    numbers = [name for name in read if name not in _TEXT]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)  # a line that is too long
            table = pd.read_csv(
                path,
                dtype=dict.fromkeys(_TEXT, str),
                # Names of tasks such as "NA" stay text.
                keep_default_na=False,
                na_values={name: [""] for name in numbers},
                index_col=False,
            )
        if lacking := [name for name in read if name not in table and name not in _OPTIONAL]:
            raise ValueError(f"it lacks the columns {', '.join(lacking)}")
        table = table.reindex(columns=[*table, *(name for name in read if name not in table)])
        for name in numbers:
            _check_numbers(table[name].astype(float), name)
        whole = [name for name in numbers if name in _WHOLE and table[name].notna().all()]
        return table.astype(dict.fromkeys(whole, np.int64))
    except FileNotFoundError:
        raise _missing(path) from None
    except pd.errors.EmptyDataError:
        return pd.DataFrame(columns=pd.Index(read))
    except (OSError, EOFError, zlib.error, ValueError, pd.errors.ParserWarning) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(
            f"{path} is damaged, or no table of a run ({reason}): resume the run, which writes it "
            "again, or name another run"
        ) from None


def _check_numbers(column: pd.Series, name: str) -> None:
    """Raise ``ValueError`` for a number that no run writes."""
    valid = column.between(0, 1 if name in _SHARES else np.finfo(float).max)
    if name in _WHOLE:
        valid &= column % 1 == 0
    if name in _OPTIONAL:
        valid |= column.isna()
    if not valid.all():
        raise ValueError(f"{name} is {column[~valid].iloc[0]:g}")


def _missing(path: Path) -> ValueError:
    if not path.parent.exists():
        return ValueError(f"there is no run at {path.parent}: name another")
    return ValueError(f"{path} is missing: let the run in {path.parent} finish")


def read_json(
    path: str | os.PathLike[str], entries: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Return the content of a run's ``config.json`` or ``summary.json``.

    ``entries`` are types of required entries; an entry that may be ``None`` may be missing.

    Raises:
        ValueError: If the file is missing or damaged.
    """
    path = Path(path)
    try:
        found = json.loads(path.read_text())
    except FileNotFoundError:
        raise _missing(path) from None
    except (OSError, ValueError):
        found = None
    if not isinstance(found, dict) or not all(
        isinstance(found.get(name), kind) for name, kind in (entries or {}).items()
    ):
        raise ValueError(f"{path} is damaged: put it back as the run left it, or run it again")
    return found


# Entries of config.json that belong to keeping a run, not to what it is.
OF_KEEPING = ("seeds", "checkpoint_minutes", "task_modules")
# Entries of summary.json, a value per seed.
OF_SEEDS = ("learned_episodes", "nodes", "groups", "group_purity")


@dataclass(frozen=True, eq=False)  # Tables have no truth value.
class Run:
    """Settings, summary and tables of a run, or of runs that differ only in their seeds.

    Seeds and tasks are in the order of ``config.json``.
    """

    directories: tuple[Path, ...]
    config: dict[str, Any]
    summary: dict[str, Any]
    tests: pd.DataFrame
    """Test episodes, ``eval.csv``."""
    training: pd.DataFrame | None = None
    """Training episodes, ``train.csv``."""
    final: pd.DataFrame | None = None
    """Tests after training, ``final.csv``."""
    costs: pd.DataFrame | None = None
    """``cost.csv``."""

    @property
    def directory(self) -> Path:
        """The first directory."""
        return self.directories[0]

    @property
    def place(self) -> Path:
        """The directory, or the folder of several."""
        return self.directory if len(self.directories) == 1 else self.directory.parent

    @property
    def algorithm(self) -> str:
        """Name of the algorithm."""
        return self.config["name"]

    @property
    def changed(self) -> dict[str, Any]:
        """Hyperparameters that are not the algorithm's usual ones, by name."""
        return self.summary.get("changed") or {}

    @property
    def seeds(self) -> tuple[int, ...]:
        """The ``S`` seeds."""
        return tuple(self.config["seeds"])

    @property
    def tasks(self) -> tuple[str, ...]:
        """Names of the ``T`` tasks, in the order of their presentation."""
        return tuple(self.config["tasks"])

    @property
    def starts(self) -> list[int]:
        """Episode from which each task is presented."""
        return self.config["task_starts"]

    @property
    def schedule(self) -> str:
        """By which of the presented tasks training episodes are drawn; see `RunConfig`."""
        return self.config["schedule"]

    @property
    def presented(self) -> dict[str, int]:
        """Episode from which each task is presented, by task."""
        return dict(zip(self.tasks, self.starts, strict=True))

    @cached_property
    def episodes(self) -> NDArray[np.int64]:
        """Training episodes before each evaluation, increasing, ``[E]``."""
        return np.unique(self.tests["episode"].to_numpy(np.int64))

    @cached_property
    def success(self) -> NDArray[np.float64]:
        """Share of successes among a seed's test episodes of a task, ``[S, E, T]``.

        NaN where a task was not tested, because it had not been presented yet.
        """
        means = self.tests.groupby(["seed", "episode", "task"])["success"].mean()
        axes = (self.seeds, self.episodes, self.tasks)
        every = pd.MultiIndex.from_product(axes)
        return means.reindex(every).to_numpy(float).reshape([*map(len, axes)])

    def by_seed_and_task(self, values: pd.Series) -> NDArray[np.float64]:
        """Return values by seed and task as an array ``[S, T]``; NaN where there are none."""
        every = pd.MultiIndex.from_product([self.seeds, self.tasks])
        return values.reindex(every).to_numpy(float).reshape(len(self.seeds), len(self.tasks))

    @property
    def last(self) -> int:
        """Training episodes before the last test."""
        return int(self.episodes[-1])

    @property
    def eval_every(self) -> int:
        """Training episodes between tests."""
        return self.config["eval_every"]

    @property
    def unfinished(self) -> str:
        """In what the run is not finished; "" if it is."""
        episodes = self.config["episodes"]
        if self.tests.empty:
            return "holds no test episode"
        if self.summary.get("episodes", episodes) != episodes:
            return "is being extended"
        if episodes - self.last >= self.eval_every:
            return f"has tests until episode {self.last} of {episodes}"
        # Its hyperparameters are not told yet, and its last tests may be written in part.
        if not self.summary and (self.directory / "checkpoint").exists():
            return "has no summary (run_experiment writes it, Trainer alone does not)"
        return ""


def read_run(directory: str | os.PathLike[str]) -> Run:
    """Read a run; each of its tables once.

    Raises:
        ValueError: If a file is missing or damaged.
    """
    directory = Path(directory)
    entries: dict[str, Any] = {"name": str, "schedule": str, "episodes": int, "eval_every": int}
    entries |= dict.fromkeys(("seeds", "tasks", "task_starts"), list)
    config = read_json(directory / "config.json", entries)
    tasks, starts = config["tasks"], config["task_starts"]
    named = all(isinstance(task, str) for task in tasks)
    if not named or len(tasks) != len(starts) or not all(type(start) is int for start in starts):
        raise ValueError(
            f"{directory / 'config.json'} does not say when each task starts: put it back as the "
            "run left it"
        )
    seeds = config["seeds"]
    if not all(type(seed) is int for seed in seeds) or len({*seeds}) < len(seeds):
        raise ValueError(
            f"{directory / 'config.json'} has the seeds {seeds}: name whole numbers, each once"
        )
    path = directory / "summary.json"
    lists: dict[str, Any] = dict.fromkeys(OF_SEEDS, list | None)
    maps: dict[str, Any] = dict.fromkeys(("changed", "demonstrated_steps"), dict | None)
    summary = read_json(path, lists | maps) if path.exists() else {}
    tables = {
        name: read_table(directory / name) for name in COLUMNS if find_table(directory / name)
    }
    for name, table in tables.items():
        for column, known in (
            ("algorithm", [config["name"]]),
            ("seed", config["seeds"]),
            ("task", tasks),
        ):
            others = set(table.get(column, ())) - set(known)
            if others:
                raise ValueError(
                    f"{directory / name} has the {column} {min(others)!r}, which is none of "
                    f"{', '.join(map(str, known))}: put it back as the run left it"
                )
    tests = tables.get("eval.csv", pd.DataFrame(columns=pd.Index(_READ["eval.csv"])))
    if len(tests) and tests["episode"].max() > config["episodes"]:
        raise ValueError(
            f"{directory / 'eval.csv'} has tests after {tests['episode'].max()} episodes, the run "
            f"{config['episodes']}: leave later tests out, or correct episodes in config.json"
        )
    others = (tables.get(name) for name in ("train.csv", "final.csv", "cost.csv"))
    return Run((directory,), config, summary, tests, *others)


def is_finished(directory: Path, episodes: int) -> bool:
    """Return whether a run of so many episodes was tested at its end and has their summary.

    Raises:
        ValueError: If the summary is damaged.
    """
    path = directory / "summary.json"
    if not (path.exists() and (directory / "final.csv").exists()):
        return False
    return read_json(path).get("episodes") == episodes


def run_directories(paths: Iterable[Path]) -> list[Path]:
    """Return the run directories among some paths and, of other folders, in them.

    Raises:
        ValueError: If a path is not a directory, or holds no run.
    """
    found: list[Path] = []
    for path in paths:
        if not path.is_dir():
            raise ValueError(f"{path} is not a directory: name a run, or a folder of runs")
        runs = _runs_in(path)
        if not runs:
            raise ValueError(f"{path} holds no run: name a run, or a folder of runs")
        found += runs
    return found


def _runs_in(path: Path) -> list[Path]:
    if (path / "config.json").exists():
        return [path]
    return [run for folder in sorted(path.glob("*/")) for run in _runs_in(folder)]


def archive_run(run: Path, target: Path) -> None:
    """Copy what reports and figures read of a finished run.

    Settings, summary, final tests and cost are copied as they are. Of ``train.csv`` and
    ``eval.csv``, the columns that are read are written as gzip. The same run always gives the same
    bytes, and an archived run can be archived again.

    Raises:
        ValueError: If a file of the run is missing or damaged, or ``target`` is the run, or holds
            another one.
        OSError: If the copy cannot be written.
    """
    config = read_json(run / "config.json")
    if (target / "config.json").exists() and (
        run.samefile(target) or read_json(target / "config.json") != config
    ):
        raise ValueError(f"{target} is the run, or holds another: name another folder for the copy")
    copied = ("config.json", "summary.json", "final.csv", "cost.csv")
    content = {name: (run / name).read_bytes() for name in copied if (run / name).exists()}
    for name in ("train.csv", "eval.csv"):
        if path := find_table(run / name):
            table = pd.read_csv(path, dtype=str, keep_default_na=False)
            text = table[[c for c in table if c in _READ[name]]].to_csv(index=False)
            content[f"{name}.gz"] = gzip.compress(text.encode(), mtime=0)
    make_folder(target)
    for name, data in content.items():
        write_whole(target / name, data)
