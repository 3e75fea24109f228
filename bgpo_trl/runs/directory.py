"""Contents of a run directory, and the checks before a run starts or resumes in it."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bgpo_trl.files.checkpoint import has_checkpoint, load_checkpoint
from bgpo_trl.files.csv_file import check_position, has_rows
from bgpo_trl.files.writing import make_folder, write_json
from bgpo_trl.runs.results import read_json

CSV_FILES = ("train.csv", "eval.csv")
"""Files to which a run appends rows."""


def holds_run(directory: str | os.PathLike[str]) -> bool:
    """Return whether a directory holds any file of a run."""
    names = ("config.json", *CSV_FILES, "checkpoint")
    return any((Path(directory) / name).exists() for name in names)


def plain_settings(config: Any) -> Any:
    """Return settings as JSON stores them, so that they compare equal when read back.

    Args:
        config: A dataclass instance or a mapping.
    """
    if dataclasses.is_dataclass(config) and not isinstance(config, type):
        config = dataclasses.asdict(config)
    return json.loads(json.dumps(config, default=str))


def check_settings(directory: str | os.PathLike[str], config: Any, *, longer: bool = False) -> None:
    """Check that a directory holds no run, or one with the given settings.

    Args:
        directory: A run directory, which may be missing.
        config: Settings of a run, a dataclass instance or a mapping.
        longer: Whether the existing run may have fewer ``episodes``.

    Raises:
        ValueError: If the directory holds a run with other settings.
    """
    path = Path(directory) / "config.json"
    if path.exists():
        _compare(directory, read_json(path), config, longer)


def claim_directory(directory: Path, config: Any, *, resume: bool) -> None:
    """Write ``config.json``, unless the directory holds a run that must not be continued.

    Args:
        directory: The run directory, made if missing.
        config: Settings of the run, a dataclass instance or a mapping.
        resume: Whether the directory may hold this run, possibly with fewer ``episodes``.

    Raises:
        ValueError: If the directory holds a run with other settings, or any run without
            ``resume``.
        OSError: If the directory cannot be written.
    """
    check_settings(directory, config, longer=resume)
    if not resume and holds_run(directory):
        raise ValueError(
            f"{directory} already holds a run: resume it, or choose another run directory."
        )
    make_folder(directory)
    path = directory / "config.json"
    try:
        write_json(path, plain_settings(config))
    except OSError as error:
        raise OSError(
            f"cannot write {path} ({error.strerror}): make room, or choose another run directory"
        ) from None


def load_last(directory: Path, config: Any) -> dict[str, Any] | None:
    """Read the checkpoint that a run resumes from, without changing any file.

    Args:
        directory: The run directory.
        config: Settings of the run, a dataclass instance or a mapping; ``episodes`` may have grown.

    Returns:
        The state saved by `Trainer`; ``None`` if nothing has been logged yet.

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
    # Checkpoints of earlier versions hold no settings; for those config.json has been compared.
    _compare(folder, state.get("settings", config), config, longer=True)
    for name, position in state["position"].items():
        check_position(directory / name, position)
    return state


def _compare(where: str | os.PathLike[str], saved: Any, config: Any, longer: bool) -> None:
    old, new = (
        # A module that was renamed adds the same tasks.
        {name: v for name, v in _flatten(settings) if not name.startswith("task_modules")}
        for settings in (saved, plain_settings(config))
    )
    if longer and type(old.get("episodes")) is type(new.get("episodes")) is int:
        old["episodes"] = max(old["episodes"], new["episodes"])
    differences = [
        f"{name} is {old.get(name, 'absent')} there and {new.get(name, 'absent')} here"
        for name in {**old, **new}
        if name not in old or name not in new or old[name] != new[name]
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
