"""Run directories: their checks before a run starts or resumes, and the logs written to them."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

from bgpo_trl.files.checkpoint import has_checkpoint, load_checkpoint
from bgpo_trl.files.csv_file import CsvFile, check_position, has_rows
from bgpo_trl.files.writing import make_folder, write_json
from bgpo_trl.runs.results import COLUMNS, read_json
from bgpo_trl.scenes import find_scene

CSV_FILES = ("train.csv", "eval.csv")
"""Files to which a run appends rows."""
_OF_A_CHECKPOINT: Mapping[str, type] = {
    "settings": dict,
    "position": dict,
    "algorithm": dict,
    "world": dict,
    "evaluator": dict,
    "state": dict,
    "env_steps": int,
    "later": list,
}


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
        longer: Whether the existing run may have fewer ``episodes``, and lack the last tasks.

    Raises:
        ValueError: If the directory holds a run with other settings, or of another version of the
            scene.
    """
    path = Path(directory) / "config.json"
    if path.exists():
        saved = read_json(path)
        if "scene_version" in saved and saved.get("scene") == settings.get("scene"):
            remedy = "use the version that it began in, or begin a new run in another directory"
            identity = f"{saved['scene']} {saved['scene_version']}"
            find_scene(settings["scene"]).check_identity(identity, directory, remedy)
        _compare(directory, saved, settings, longer)


def load_last(directory: Path, settings: Mapping[str, Any]) -> dict[str, Any] | None:
    """Read the checkpoint that a run resumes from, without changing any file.

    Args:
        directory: The run directory.
        settings: Settings of the run, as JSON stores them; ``episodes`` and tasks may have grown.

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
    check_checkpoint(folder, state, settings)
    for name, position in state["position"].items():
        check_position(directory / name, position)
    return state


def check_checkpoint(folder: Path, state: Mapping[str, Any], settings: Mapping[str, Any]) -> None:
    """Check that a checkpoint is `Trainer`'s, of these settings or fewer episodes or tasks.

    Args:
        folder: Folder of the checkpoint.
        state: Its content.
        settings: Settings of the run, as JSON stores them.

    Raises:
        ValueError: If entries are missing, or settings differ.
    """
    missing = [
        name for name, kind in _OF_A_CHECKPOINT.items() if not isinstance(state.get(name), kind)
    ]
    if missing:
        raise ValueError(
            f"{folder} holds no checkpoint of a run, it lacks {', '.join(missing)}: put it back as "
            "the run left it, or begin a new run in another directory"
        )
    remedy = "put config.json back as the run left it, or choose another run directory"
    _compare(folder, state["settings"], settings, longer=True, remedy=remedy)


@contextlib.contextmanager
def fitting_checkpoint(directory: Path) -> Iterator[None]:
    """Turn errors of loading a checkpoint's state, in the block, into one line.

    Raises:
        ValueError: If the state does not fit what it is loaded into.
    """
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


def _compare(
    where: str | os.PathLike[str],
    saved: Mapping[str, Any],
    settings: Mapping[str, Any],
    longer: bool,
    remedy: str = "choose another run directory, or the same settings.",
) -> None:
    if "offline_updates" in settings:
        saved = {"offline_updates": 0, **saved}  # which runs before this setting lack
    if longer:
        saved = _as_grown(saved, settings)
    differences = [
        f"{name} is {old} there and {new} here"
        for name, old, new in differing_settings(saved, settings)
    ]
    if differences:
        raise ValueError(
            f"{where} holds a run with other settings ({'; '.join(differences)}): {remedy}"
        )


def _as_grown(saved: Mapping[str, Any], settings: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return settings with the length and further tasks of others, if they could grow into these.

    Demonstrations of further tasks change the digest of the bank, which `Trainer` checks.
    """
    grown = {}
    if type(saved.get("episodes")) is type(settings.get("episodes")) is int:
        grown["episodes"] = max(saved["episodes"], settings["episodes"])
    of_tasks = ("tasks", "task_starts")
    lists = [(saved.get(name), settings.get(name)) for name in of_tasks]
    if all(
        isinstance(old, list) and isinstance(new, list) and old == new[: len(old)] != new
        for old, new in lists
    ):
        grown |= {name: settings.get(name) for name in (*of_tasks, "bank")}
    return {**saved, **grown}


def flatten(settings: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the names and values of nested settings, such as ``"algorithm.rl.gamma"``."""
    if isinstance(settings, dict):
        for name, value in settings.items():
            yield from flatten(value, f"{prefix}.{name}" if prefix else name)
    else:
        yield prefix, settings


class RunLogger:
    """Write the log of a run into its directory; `COLUMNS` says what the tables hold.

    Args:
        directory: The run directory; made if missing.
        config: Settings of the run, as JSON stores them, written to ``config.json``.
        logged: Further columns of ``train.csv``; see `Algorithm`.
        resume: Continue the run in the directory, which may have had fewer ``episodes``; call
            `truncate_to` next.

    Raises:
        ValueError: If the directory holds a run with other settings or columns, or any run without
            ``resume``; if a name in ``logged`` is that of another column.
        OSError: If the directory cannot be written.

    Examples:
        >>> import tempfile
        >>> directory = Path(tempfile.mkdtemp()) / "run"
        >>> with RunLogger(directory, config={"gamma": 0.98}) as logger:
        ...     logger.log_eval({"algorithm": "bgpo", "seed": 0, "episode": 1, "success": True})
        >>> (directory / "eval.csv").read_text().splitlines()[1]
        'bgpo,0,1,,,1,,'
    """

    def __init__(
        self,
        directory: str | os.PathLike[str],
        *,
        config: Mapping[str, Any],
        logged: Sequence[str] = (),
        resume: bool = False,
    ) -> None:
        self.directory = Path(directory)
        columns = (*COLUMNS["train.csv"], *logged)
        repeated = {name for name in logged if columns.count(name) > 1}
        if repeated:
            raise ValueError(
                f"train.csv has the column {', '.join(sorted(repeated))} already: choose other "
                "names for what the algorithm logs"
            )
        if not resume and holds_run(self.directory):
            raise ValueError(
                f"{self.directory} already holds a run: resume it, or choose another run directory."
            )
        make_folder(self.directory)
        write_json(self.directory / "config.json", config)
        self._files = {
            name: CsvFile(self.directory / name, columns)
            for name, columns in (("train.csv", columns), ("eval.csv", [*COLUMNS["eval.csv"]]))
        }

    def log_train(self, row: Mapping[str, Any]) -> None:
        """Write a training episode, values by column; missing ones stay empty.

        Raises:
            ValueError: If there is no such column.
            OSError: If the row cannot be written.
        """
        self._files["train.csv"].write(row)

    def log_eval(self, row: Mapping[str, Any]) -> None:
        """Write a test episode; see `log_train`."""
        self._files["eval.csv"].write(row)

    def position(self) -> dict[str, int]:
        """Flush the CSV files to disk and return their sizes, for the checkpoint."""
        return {name: file.position() for name, file in self._files.items()}

    def truncate_to(self, position: Mapping[str, int]) -> None:
        """Drop the rows that a resumed run will write again.

        Args:
            position: Result of `position` saved in the checkpoint; empty to start over, for a run
                that ended before its first checkpoint.

        Raises:
            ValueError: If a file is shorter.
        """
        for name, file in self._files.items():
            file.truncate_to(position.get(name, 0))

    def close(self) -> None:
        """Close the CSV files."""
        for file in self._files.values():
            file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
