"""Contents of a run directory, and the checks before a run starts or resumes in it."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
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


def check_settings(
    directory: str | os.PathLike[str], settings: Mapping[str, Any], *, longer: bool = False
) -> None:
    """Check that a directory holds no run, or one with the given settings.

    Args:
        directory: A run directory, which may be missing.
        settings: Settings of a run, as JSON stores them.
        longer: Whether the existing run may have fewer ``episodes``.

    Raises:
        ValueError: If the directory holds a run with other settings.
    """
    path = Path(directory) / "config.json"
    if path.exists():
        _compare(directory, read_json(path), settings, longer)


def claim_directory(directory: Path, settings: Mapping[str, Any], *, resume: bool) -> None:
    """Write ``config.json``, unless the directory holds a run that must not be continued.

    Args:
        directory: The run directory, made if missing.
        settings: Settings of the run, as JSON stores them.
        resume: Whether the directory may hold this run, possibly with fewer ``episodes``.

    Raises:
        ValueError: If the directory holds a run with other settings, or any run without
            ``resume``.
        OSError: If the directory cannot be written.
    """
    check_settings(directory, settings, longer=resume)
    if not resume and holds_run(directory):
        raise ValueError(
            f"{directory} already holds a run: resume it, or choose another run directory."
        )
    make_folder(directory)
    path = directory / "config.json"
    try:
        write_json(path, settings)
    except OSError as error:
        raise OSError(
            f"cannot write {path} ({error.strerror}): make room, or choose another run directory"
        ) from None


def load_last(directory: Path, settings: Mapping[str, Any]) -> dict[str, Any] | None:
    """Read the checkpoint that a run resumes from, without changing any file.

    Args:
        directory: The run directory.
        settings: Settings of the run, as JSON stores them; ``episodes`` may have grown.

    Returns:
        The state saved by `Trainer`; ``None`` if nothing has been logged yet.

    Raises:
        ValueError: If settings, rows or checkpoint are missing, damaged or of another run.
    """
    check_settings(directory, settings, longer=True)
    folder = directory / "checkpoint"
    remedy = "put it back as the run left it, or begin a new run in another directory"
    if not has_checkpoint(folder):
        if any(has_rows(directory / name) for name in CSV_FILES):
            raise ValueError(f"{directory} has rows of a run, but no checkpoint: {remedy}")
        return None
    if not (directory / "config.json").exists():
        raise ValueError(f"{directory} has a checkpoint, but no config.json: {remedy}")
    state = load_checkpoint(folder)
    _compare(folder, state["settings"], settings, longer=True)
    for name, position in state["position"].items():
        check_position(directory / name, position)
    return state


def _compare(
    where: str | os.PathLike[str],
    saved: Mapping[str, Any],
    settings: Mapping[str, Any],
    longer: bool,
) -> None:
    # A module that was renamed adds the same tasks.
    old, new = (
        dict(flatten({name: value for name, value in given.items() if name != "task_modules"}))
        for given in (saved, settings)
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


def flatten(settings: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the names and values of nested settings, such as ``"algorithm.rl.gamma"``."""
    if isinstance(settings, dict):
        for name, value in settings.items():
            yield from flatten(value, f"{prefix}.{name}" if prefix else name)
    else:
        yield prefix, settings
