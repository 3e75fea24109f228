"""Run directories: their checks before a run starts or resumes, and the logs written to them."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from bgpo_trl.files.checkpoint import has_checkpoint, load_checkpoint
from bgpo_trl.files.csv_file import CsvFile
from bgpo_trl.files.writing import make_folder, write_json, write_whole
from bgpo_trl.runs.results import COLUMNS, read_json, read_table

_CSV_FILES = ("train.csv", "eval.csv")  # to which a run appends rows
_NAMED = 5  # differing settings that an error names
_REMEDY = "put it back as the run left it, or begin a new run in another directory"


def holds_run(directory: str | os.PathLike[str]) -> bool:
    """Return whether a directory holds any file of a run."""
    names = ("config.json", *_CSV_FILES, "checkpoint")
    return any((Path(directory) / name).exists() for name in names)


def digest_of_logged(directory: Path) -> str | None:
    """Return the digest of the logged episodes that a run with a checkpoint has learned, if any."""
    path = directory / "config.json"
    if not path.exists() or not has_checkpoint(directory / "checkpoint"):
        return None
    return read_json(path).get("logged")


def load_last(directory: Path, settings: Mapping[str, Any]) -> dict[str, Any] | None:
    """Read the checkpoint that a run resumes from, without changing any file.

    ``settings`` are as JSON stores them. The run may have had fewer ``episodes``, and lacked the
    last tasks.

    Returns:
        The state saved by `Trainer`; ``None`` if nothing has been logged yet.

    Raises:
        ValueError: If settings, rows or checkpoint are missing, damaged or of another run.
    """
    if (directory / "config.json").exists():
        _compare(directory, read_json(directory / "config.json"), settings)
    tables = {name: directory / name for name in _CSV_FILES}
    if not has_checkpoint(directory / "checkpoint"):
        if any(path.exists() and path.read_bytes().count(b"\n") > 1 for path in tables.values()):
            raise ValueError(f"{directory} has rows of a run, but no checkpoint: {_REMEDY}")
        return None
    state = read_checkpoint(directory, settings)
    for name, path in tables.items():
        if not path.exists() or path.stat().st_size < state["position"][name]:
            raise ValueError(f"{path} lacks rows from before the checkpoint: {_REMEDY}")
    return state


def check_settings(directory: Path, settings: Mapping[str, Any]) -> None:
    """Raise ``ValueError`` if a run has others than these of its settings, such as ``bank``."""
    saved = read_json(directory / "config.json")
    _compare(directory, saved, {**saved, **settings})


def read_checkpoint(
    directory: Path, settings: Mapping[str, Any], *, mmap: bool = False, newest: bool = False
) -> dict[str, Any]:
    """Read the last checkpoint of a run with these settings, or with fewer episodes or tasks.

    Raises:
        ValueError: If there is no intact checkpoint, or it is not of a run with these settings.
    """
    folder = directory / "checkpoint"
    state = load_checkpoint(folder, mmap=mmap, newest=newest)
    if not isinstance(state.get("settings"), dict):
        raise ValueError(f"{folder} holds no checkpoint of a run: {_REMEDY}")
    _compare(folder, state["settings"], settings)
    return state


@contextlib.contextmanager
def fitting_checkpoint(directory: Path) -> Iterator[None]:
    """Turn errors of loading a checkpoint's state in the block into one line."""
    try:
        yield
    except (AttributeError, LookupError, RuntimeError, TypeError, ValueError) as error:
        reason = (str(error) or type(error).__name__).splitlines()[-1].strip()
        raise ValueError(
            f"{directory / 'checkpoint'} does not fit {directory / 'config.json'} ({reason}): use "
            "the version of the code, and the make, of the run"
        ) from error


def differing_settings(
    settings: Mapping[str, Any], others: Mapping[str, Any]
) -> list[tuple[str, Any, Any]]:
    """Return names and both values of the settings that differ, such as ``algorithm.beta``.

    A setting that one lacks has the value ``"absent"`` there. Modules that add tasks are passed
    over, since a module that was renamed adds the same tasks.
    """
    old, new = (
        dict(flatten({name: value for name, value in given.items() if name != "task_modules"}))
        for given in (settings, others)
    )
    return [
        (name, old.get(name, "absent"), new.get(name, "absent"))
        for name in {**old, **new}
        if name not in old or name not in new or old[name] != new[name]
    ]


def _compare(where: Path, saved: Mapping[str, Any], settings: Mapping[str, Any]) -> None:
    """Raise ``ValueError`` if settings differ, beside a larger length and further tasks."""
    differing = differing_settings(_as_grown(saved, settings), settings)
    differing.sort(key=lambda one: one[0].count("."))
    if differing:
        differences = [f"{name} is {old} there and {new} here" for name, old, new in differing]
        if len(differences) > _NAMED:
            differences[_NAMED:] = [f"and {len(differences) - _NAMED} more"]
        raise ValueError(
            f"{where} holds a run with other settings ({'; '.join(differences)}): choose another "
            "run directory, or the settings and the version of the run"
        )


def _as_grown(saved: Mapping[str, Any], settings: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return settings with the length and further tasks of others, if they could grow into these.

    How often checkpoints are written changes nothing that is learned.

    Demonstrations of further tasks change the digest of the bank, which `Trainer` checks.
    """
    grown = dict(saved)
    if type(saved.get("episodes")) is type(settings.get("episodes")) is int:
        grown["episodes"] = max(saved["episodes"], settings["episodes"])
    if "checkpoint_minutes" in settings:
        grown["checkpoint_minutes"] = settings["checkpoint_minutes"]
    of_tasks = ("tasks", "task_starts")
    lists = [(saved.get(name), settings.get(name)) for name in of_tasks]
    if all(
        isinstance(old, list) and isinstance(new, list) and old == new[: len(old)] != new
        for old, new in lists
    ):
        grown |= {name: settings.get(name) for name in (*of_tasks, "bank")}
    return grown


@contextlib.contextmanager
def replacing_costs(directory: Path) -> Iterator[None]:
    """Keep the costs of the last checkpoint while the block replaces both.

    See `put_back_costs`. Checkpoints hold no costs, in which equal runs differ.
    """
    now, before = _costs(directory)
    if has_checkpoint(before.parent) and now.exists() and not before.exists():
        write_whole(before, now.read_bytes())
    yield
    before.unlink(missing_ok=True)


def put_back_costs(directory: Path, steps: int) -> None:
    """Put back the costs of a checkpoint, of so many steps, if a kill came before the next one.

    Raises:
        ValueError: If they are damaged.
    """
    now, before = _costs(directory)
    if before.exists():
        if read_table(before)["steps"].sum() == steps:
            before.replace(now)
        else:  # the kill came after the next one
            before.unlink()


def _costs(directory: Path) -> tuple[Path, Path]:
    return directory / "cost.csv", directory / "checkpoint" / "cost.csv"


def flatten(settings: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the names and values of nested settings, such as ``"algorithm.rl.gamma"``."""
    if isinstance(settings, dict):
        for name, value in settings.items():
            yield from flatten(value, f"{prefix}.{name}" if prefix else name)
    else:
        yield prefix, settings


@contextlib.contextmanager
def open_tables(
    directory: str | os.PathLike[str],
    *,
    config: Mapping[str, Any],
    logged: Sequence[str] = (),
    position: Mapping[str, int] | None = None,
) -> Iterator[dict[str, CsvFile]]:
    """Write the settings of a run, and hold ``train.csv`` and ``eval.csv`` open for rows.

    Args:
        directory: The run directory; made if missing.
        config: Settings of the run, as JSON stores them, written to ``config.json``.
        logged: Further columns of ``train.csv`` beside its `COLUMNS`; see `Algorithm`.
        position: To continue a run, the position of each table in its checkpoint: later rows are
            dropped; empty to start over, for a run that ended before its first checkpoint.

    Yields:
        The tables by file name.

    Raises:
        ValueError: If the directory holds any run without ``position``; if its tables have other
            columns, or are shorter; if a name in ``logged`` is that of another column.
        OSError: If the directory cannot be written.

    Examples:
        >>> import tempfile
        >>> directory = Path(tempfile.mkdtemp()) / "run"
        >>> with open_tables(directory, config={"gamma": 0.98}) as tables:
        ...     tables["eval.csv"].write({"algorithm": "bgpo", "seed": 0, "success": True})
        >>> (directory / "eval.csv").read_text().splitlines()[1]
        'bgpo,0,,,,1,,'
    """
    directory = Path(directory)
    columns = {name: COLUMNS[name] for name in _CSV_FILES}
    columns["train.csv"] += tuple(logged)
    repeated = {name for name in logged if columns["train.csv"].count(name) > 1}
    if repeated:
        raise ValueError(
            f"train.csv has the column {', '.join(sorted(repeated))} already: choose other "
            "names for what the algorithm logs"
        )
    if position is None and holds_run(directory):
        raise ValueError(
            f"{directory} already holds a run: resume it, or choose another run directory."
        )
    make_folder(directory)
    with contextlib.ExitStack() as opened:
        tables = {
            name: opened.enter_context(CsvFile(directory / name, of_table))
            for name, of_table in columns.items()
        }
        for name, table in tables.items():
            table.truncate_to((position or {}).get(name, 0))
        write_json(directory / "config.json", config)
        yield tables
