"""What a run's directory holds, and whether a run may begin or go on there."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bgpo_trl.files.checkpoint import has_checkpoint, load_checkpoint
from bgpo_trl.files.csv_file import check_position, has_rows
from bgpo_trl.files.folders import make_folder
from bgpo_trl.runs.results import read_json

CSV_FILES = ("train.csv", "eval.csv")
"""What a run writes row by row."""


def holds_run(directory: str | os.PathLike[str]) -> bool:
    """Returns whether there is anything of a run in a directory."""
    names = ("config.json", *CSV_FILES, "checkpoint")
    return any((Path(directory) / name).exists() for name in names)


def plain_settings(config: Any) -> Any:
    """Returns settings as JSON keeps them, so that they compare equal when read back.

    Args:
        config: A dataclass instance or a mapping.
    """
    if dataclasses.is_dataclass(config) and not isinstance(config, type):
        config = dataclasses.asdict(config)
    return json.loads(json.dumps(config, default=str))


def check_settings(directory: str | os.PathLike[str], config: Any, *, longer: bool = False) -> None:
    """Makes sure that a directory holds no run, or one with these settings.

    Args:
        directory: A run directory, there or not.
        config: Settings of a run, a dataclass instance or a mapping.
        longer: Whether that run may have fewer ``episodes``.

    Raises:
        ValueError: If it holds a run with other settings.
    """
    path = Path(directory) / "config.json"
    if path.exists():
        _compare(directory, read_json(path), config, longer)


def claim_directory(directory: Path, config: Any, *, resume: bool) -> None:
    """Writes ``config.json``, unless the directory holds a run that this one may not continue.

    Args:
        directory: Made if it does not exist.
        config: Settings of the run, a dataclass instance or a mapping.
        resume: Whether it may hold that run, or its first ``episodes``.

    Raises:
        ValueError: If the directory holds a run with other settings, or any without ``resume``.
        OSError: If the directory cannot be written.
    """
    check_settings(directory, config, longer=resume)
    if not resume and holds_run(directory):
        raise ValueError(
            f"{directory} already holds a run: resume it, or choose another run directory."
        )
    make_folder(directory)
    path = directory / "config.json"
    temporary = path.with_suffix(".tmp")
    try:
        temporary.write_text(json.dumps(plain_settings(config), indent=2) + "\n")
        temporary.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise OSError(
            f"cannot write {path} ({error.strerror}): make room, or choose another run directory"
        ) from None


def load_last(directory: Path, config: Any) -> dict[str, Any] | None:
    """Reads the checkpoint that a run goes on from, and changes nothing.

    Args:
        directory: The run's.
        config: Its settings, a dataclass instance or a mapping; ``episodes`` may have grown.

    Returns:
        What the `Trainer` saved; None if nothing has been logged yet.

    Raises:
        ValueError: If settings, rows or checkpoint are missing, damaged or of another run.
    """
    check_settings(directory, config, longer=True)
    folder = directory / "checkpoint"
    remedy = "put it back as the run left it, or begin a new run in another directory"
    if not has_checkpoint(folder):
        if any(has_rows(directory / name) for name in CSV_FILES):
            raise ValueError(f"{directory} has rows of a run, but no checkpoint: {remedy}")
        return None
    if not (directory / "config.json").exists():
        raise ValueError(f"{directory} has a checkpoint, but no config.json: {remedy}")
    state = load_checkpoint(folder)
    # Checkpoints did not always say; then config.json alone does.
    _compare(folder, state.get("settings", config), config, longer=True)
    for name, position in state["position"].items():
        check_position(directory / name, position)
    return state


def _compare(where: str | os.PathLike[str], there: Any, here: Any, longer: bool) -> None:
    there, here = dict(_flatten(there)), dict(_flatten(plain_settings(here)))
    if longer and type(there.get("episodes")) is type(here.get("episodes")) is int:
        there["episodes"] = max(there["episodes"], here["episodes"])
    differences = [
        f"{name} is {there.get(name, 'absent')} there and {here.get(name, 'absent')} here"
        for name in {**there, **here}
        if name not in there or name not in here or there[name] != here[name]
    ]
    if differences:
        raise ValueError(
            f"{where} holds a run with other settings ({'; '.join(differences)}): "
            "choose another run directory, or the same settings."
        )


def _flatten(settings: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(settings, dict):
        for name, value in settings.items():
            yield from _flatten(value, f"{prefix}.{name}" if prefix else name)
    else:
        yield prefix, settings
