"""Dashboards: means of a run, for Weights & Biases, TensorBoard or any other logger of TorchRL."""

from __future__ import annotations

import json
import os
import uuid
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import pandas as pd
from torchrl.record.loggers.common import Logger
from torchrl.record.loggers.tensorboard import TensorboardLogger
from torchrl.record.loggers.wandb import WandbLogger

from bgpo_trl.files.writing import write_whole
from bgpo_trl.runs.directory import flatten
from bgpo_trl.runs.provenance import commit_of_code, versions
from bgpo_trl.runs.results import read_table

# Columns of which there is no mean.
_NO_MEASURES = ["algorithm", "seed", "episode", "task", "group"]


class Dashboard:
    """Log the means of a run to loggers, at the step of the training episodes of a seed.

    | key | mean over |
    |---|---|
    | ``eval/success/TASK`` | seeds and test episodes of an evaluation |
    | ``eval/success_mean`` | tasks presented so far, seeds and test episodes |
    | ``train/success/TASK``, ``train/success_mean`` | training episodes since the last evaluation |
    | ``train/COLUMN``, such as ``train/loss_actor`` | the same, of each number in ``train.csv`` |
    | ``final/success/TASK``, ``final/success_mean`` | seeds and tests after training |

    The settings, the commit and the versions of packages are logged as hyperparameters once, by
    names such as ``algorithm.beta``. A logger that raises is dropped with one warning.

    Args:
        directory: The run directory. Training episodes in its ``train.csv`` that no evaluation
            follows belong to the next one, so that a resumed run logs the same means.
        loggers: Loggers, or functions without arguments that make one.
        settings: Settings of the run, as JSON stores them.

    Raises:
        ValueError: If there are loggers and ``train.csv`` or ``eval.csv`` is missing or damaged.
    """

    def __init__(
        self,
        directory: str | os.PathLike[str],
        loggers: Iterable[Logger | Callable[[], Logger]] = (),
        *,
        settings: Mapping[str, Any],
    ) -> None:
        loggers = [*loggers]
        # Training episodes since the last evaluation.
        self._episodes = _untested(Path(directory)) if loggers else []
        self._loggers: list[Logger] = []
        for logger in loggers:
            try:
                self._loggers.append(logger() if callable(logger) else logger)
            except Exception as error:
                _warn("A logger", error)
        settings = {**settings, "commit": commit_of_code(), "versions": versions()}
        # TensorBoard takes no lists.
        plain = {
            name: json.dumps(value) if isinstance(value, list) else value
            for name, value in flatten(settings)
        }
        self._each(lambda logger: logger.log_hparams(dict(plain)))

    def log_train(self, row: Mapping[str, Any]) -> None:
        """Add a training episode, a row of ``train.csv``, to the means of the next evaluation."""
        if self._loggers:
            self._episodes.append(row)

    def log_eval(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Log an evaluation of all seeds, rows of ``eval.csv``, and the training before it."""
        tests, episode = pd.DataFrame([*rows]), int(rows[0]["episode"])
        played = [row for row in self._episodes if row["episode"] <= episode]
        self._episodes = [row for row in self._episodes if row["episode"] > episode]
        self._log({**_success("eval", tests), **_training(played)}, episode)

    def log_final(self, tests: pd.DataFrame, episode: int) -> None:
        """Log tests after the training ``episode``, rows of ``final.csv``."""
        self._log(_success("final", tests), episode)

    def close(self) -> None:
        """Shut the loggers down."""
        self._each(lambda logger: logger.shutdown())
        self._loggers = []

    def _log(self, metrics: Mapping[str, float], episode: int) -> None:
        self._each(lambda logger: logger.log_metrics(dict(metrics), step=episode))

    def _each(self, do: Callable[[Logger], object]) -> None:
        for logger in tuple(self._loggers):
            try:
                do(logger)
            except Exception as error:
                self._loggers = [other for other in self._loggers if other is not logger]
                _warn(type(logger).__name__, error)


def wandb_logger(
    directory: str | os.PathLike[str], mode: Literal["online", "offline"], group: str
) -> WandbLogger:
    """Start a run of a group on Weights & Biases, or continue that of a run directory.

    The files go to its ``wandb/``, as does the id by which a resumed run continues its curves.
    Those of the mode ``"offline"`` are for a later ``wandb sync``.
    """
    directory = Path(directory)
    identity = directory / "wandb" / "run_id"
    identity.parent.mkdir(parents=True, exist_ok=True)
    if not identity.exists():
        write_whole(identity, uuid.uuid4().hex)
    return WandbLogger(
        directory.name,
        project="bgpo_trl",
        save_dir=str(directory),
        id=identity.read_text(),
        log_env_packages=False,  # would reveal paths of this machine
        mode=mode,  # not `offline=`, which changes os.environ for good
        group=group,
        settings={
            "init_timeout": 30,
            "finish_timeout": 60,
            "console": "off",  # would upload every redraw of the progress bar
            "x_disable_meta": True,  # command, program and folders of this machine
        },
    )


def tensorboard_logger(directory: str | os.PathLike[str]) -> TensorboardLogger:
    """Return a logger that writes to ``tensorboard/`` in a run directory."""
    return TensorboardLogger("tensorboard", log_dir=str(directory))


def check_installed(package: str) -> None:
    """Raise ``ImportError`` if the package of a logger is missing."""
    if find_spec(package) is None:
        raise ImportError(f"{package} is not installed: pip install 'bgpo_trl[{package}]'")


def _untested(directory: Path) -> list[Mapping[Any, Any]]:
    """Return the training episodes of a run after its last evaluation."""
    tested = read_table(directory / "eval.csv")["episode"]
    train = read_table(directory / "train.csv")
    train = train[train["episode"] > max(tested, default=0)]
    for name in train.columns.difference(["algorithm", "task"]):
        train[name] = pd.to_numeric(train[name], errors="coerce")
    return [*train.to_dict("records")]


def _success(group: str, table: pd.DataFrame) -> dict[str, float]:
    """Return the mean success of each task, and of all."""
    metrics = {
        f"{group}/success/{task}": float(success.mean())
        for task, success in table.groupby("task", sort=False)["success"]
    }
    return {**metrics, f"{group}/success_mean": float(table["success"].mean())}


def _training(episodes: Sequence[Mapping[Any, Any]]) -> dict[str, float]:
    """Return the means of training episodes; NaN where one is, as after a divergence."""
    if not episodes:
        return {}
    table = pd.DataFrame([*episodes])
    measures = table.drop(columns=[*_NO_MEASURES, "success"], errors="ignore")
    means = measures.select_dtypes("number").mean(skipna=False)
    metrics = {f"train/{name}": float(mean) for name, mean in means.items()}
    return {**_success("train", table), **metrics}


def _warn(name: str, error: Exception) -> None:
    reason = (str(error) or type(error).__name__).splitlines()[0]
    warnings.warn(
        f"{name} failed ({reason}) and gets nothing more of this run: the CSV files are complete.",
        stacklevel=4,
    )
