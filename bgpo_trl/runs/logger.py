"""Run logger: writes settings and CSV files, and mirrors rows to Weights & Biases.

A run directory holds ``config.json``, ``train.csv`` and ``eval.csv`` (other modules add
``checkpoint/`` and ``figures/``). The CSV files are the record of a run: they are always
written, row by row, and a resumed run continues them byte for byte. Weights & Biases is an optional
mirror whose failure does not affect the run.
"""

from __future__ import annotations

import os
import uuid
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal, Self

from torchrl.record.loggers.wandb import WandbLogger

from bgpo_trl.files.csv_file import CsvFile, plain_value
from bgpo_trl.files.writing import write_whole
from bgpo_trl.runs.directory import claim_directory

EVAL_COLUMNS = (
    "algorithm",
    "seed",
    "episode",
    "env_steps",
    "task",
    "success",
    "return",
    "steps",
)
"""Columns of ``eval.csv``, one row per test episode."""

TRAIN_COLUMNS = (
    *EVAL_COLUMNS,
    "intrinsic_return",
    "num_nodes",
    "group",
    "num_groups",
    "loss_actor",
    "loss_value",
)
"""Columns of ``train.csv``, one row per training episode."""


class RunLogger:
    """Write the log of a run into its directory, and mirror it to Weights & Biases.

    The mirror gets each row as one ``log_metrics`` call with the row's numbers, named
    ``{train,eval}/{task}/seed_{seed}/{column}``, at step ``episode``. If it raises, it is disabled
    for the rest of the run, with one warning. Rows rewritten by a resumed run reach it twice, with
    the same values and steps.

    Args:
        directory: The run directory; made if missing.
        config: Settings of the run, as JSON stores them, written to ``config.json``.
        wandb: Also log to Weights & Biases, ``"online"``, or ``"offline"`` into
            ``directory/wandb`` for a later ``wandb sync``. Needs the extra ``wandb``.
        resume: Continue the run in the directory, which may have had fewer ``episodes``; call
            `truncate_to` next.

    Raises:
        ValueError: If the directory holds a run with other settings or columns, or any run without
            ``resume``.
        OSError: If the directory cannot be written.

    Example:
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
        wandb: Literal["online", "offline"] | None = None,
        resume: bool = False,
    ) -> None:
        self.directory = Path(directory)
        if wandb not in (None, "online", "offline"):
            raise ValueError(f'wandb must be "online", "offline" or None, not {wandb!r}.')
        claim_directory(self.directory, config, resume=resume)
        self._train = CsvFile(self.directory / "train.csv", TRAIN_COLUMNS)
        self._eval = CsvFile(self.directory / "eval.csv", EVAL_COLUMNS)
        self._wandb = None if wandb is None else _wandb_logger(self.directory, config, wandb)

    def log_train(self, row: Mapping[str, Any]) -> None:
        """Write a training episode.

        Args:
            row: Values by column of `TRAIN_COLUMNS`; missing ones stay empty.

        Raises:
            ValueError: If there is no such column.
            OSError: If the row cannot be written.
        """
        self._train.write(row)
        self._mirror_row("train", row)

    def log_eval(self, row: Mapping[str, Any]) -> None:
        """Write a test episode.

        Args:
            row: Values by column of `EVAL_COLUMNS`: names of the algorithm and the task, seed,
                training episodes and environment steps of that seed so far, and the test episode's
                success, extrinsic return and length in steps.

        Raises:
            ValueError: If there is no such column.
            OSError: If the row cannot be written.
        """
        self._eval.write(row)
        self._mirror_row("eval", row)

    def log_media(self, name: str, path: str | os.PathLike[str]) -> None:
        """Upload a finished figure or video to Weights & Biases, if it is in use.

        Args:
            name: Name on the dashboard.
            path: A picture, or a video as GIF or MP4.
        """
        self._mirror(lambda wandb: _log_wandb_media(wandb, name, Path(path)))

    def position(self) -> dict[str, int]:
        """Flush the CSV files to disk and return their sizes, for the checkpoint."""
        return {file.path.name: file.position() for file in (self._train, self._eval)}

    def truncate_to(self, position: Mapping[str, int]) -> None:
        """Drop the rows that a resumed run will write again.

        Args:
            position: Result of `position` saved in the checkpoint; empty to start over, for a run
                that ended before its first checkpoint.

        Raises:
            ValueError: If a file is shorter.
        """
        for file in (self._train, self._eval):
            file.truncate_to(position.get(file.path.name, 0))

    def close(self) -> None:
        """Close the CSV files and the mirror."""
        self._train.close()
        self._eval.close()
        self._mirror(lambda wandb: wandb.shutdown())
        self._wandb = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _mirror_row(self, group: str, row: Mapping[str, Any]) -> None:
        values = {name: plain_value(value) for name, value in row.items()}
        prefix = f"{group}/{values.pop('task', 'all')}/seed_{values.pop('seed', 0)}"
        step = values.pop("episode", None)
        numbers = {
            f"{prefix}/{name}": value
            for name, value in values.items()
            if isinstance(value, int | float)
        }
        self._mirror(lambda wandb: wandb.log_metrics(numbers, step=step))

    def _mirror(self, report: Callable[[WandbLogger], object]) -> None:
        if self._wandb is None:
            return
        try:
            report(self._wandb)
        except Exception as error:
            self._wandb = None
            warnings.warn(
                f"WandbLogger failed ({_reason(error)}) and is disabled for the rest of this run: "
                "the CSV files are complete.",
                stacklevel=4,
            )


def _wandb_logger(directory: Path, settings: Mapping[str, Any], mode: str) -> WandbLogger | None:
    """Return a Weights & Biases logger, falling back to offline mode, then to none."""
    identity = directory / "wandb" / "run_id"
    for attempt in dict.fromkeys((mode, "offline")):
        try:
            identity.parent.mkdir(exist_ok=True)
            if not identity.exists() or not identity.read_text():  # killed before it was written
                write_whole(identity, uuid.uuid4().hex)
            return WandbLogger(
                directory.name,
                project="bgpo_trl",
                save_dir=str(directory),
                id=identity.read_text(),  # so that a resumed run continues its curves
                log_env_packages=False,  # would reveal paths of this machine
                config=dict(settings),
                mode=attempt,  # not `offline=`, which changes os.environ for good
                settings={
                    "init_timeout": 30,
                    "finish_timeout": 60,
                    "console": "off",  # would upload every redraw of the progress bar
                    "x_disable_meta": True,  # command, program and folders of this machine
                },
            )
        except ImportError:
            warnings.warn(
                "wandb is not installed, so this run is kept in its CSV files only: "
                "pip install 'bgpo_trl[wandb]' to log to Weights & Biases too.",
                stacklevel=3,
            )
            break
        except Exception as error:
            instead = (
                f"logging offline, upload it with `wandb sync {identity.parent}/offline-run-*`"
                if attempt == "online"
                else "the run is kept in its CSV files only"
            )
            warnings.warn(f"wandb does not answer ({_reason(error)}): {instead}.", stacklevel=3)
    return None


def _log_wandb_media(mirror: WandbLogger, name: str, path: Path) -> None:
    import wandb  # an optional extra, installed if there is a WandbLogger

    # The path rather than the frames, for which wandb (and TorchRL's log_video) needs moviepy.
    media = wandb.Video if path.suffix in (".gif", ".mp4") else wandb.Image
    mirror.experiment.log({name: media(str(path))})


def _reason(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0]
