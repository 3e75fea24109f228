"""Jobs on Ray: each is run to its end exactly once, even if workers are lost."""

from __future__ import annotations

import contextlib
import inspect
import logging
import os
import socket
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bgpo_trl.configs import RunConfig
from bgpo_trl.files.progress import progress_bar
from bgpo_trl.files.writing import lock_directory
from bgpo_trl.runs.directory import CSV_FILES

# Bounds the retries of a job that always crashes its worker.
RETRIES = 10


@dataclass(frozen=True, eq=False)  # Own hyperparameters may not be hashable.
class Job:
    """A run of a block of seeds, and its directory.

    Attributes:
        directory: Directory of the run.
        config: The run.
        module: Module that adds its tasks or algorithm, see `bgpo_trl.plugins.import_plugin`.
        bank: Demonstrations of tasks that are not the paper's.
        encoders: Encoders that do not come with the scene.
    """

    directory: Path
    config: RunConfig
    module: str | None = None
    bank: Path | None = None
    encoders: Path | None = None

    def __str__(self) -> str:
        return f"{self.directory.parent.name}/{self.directory.name}"

    @property
    def finished(self) -> bool:
        """Whether the job was run to its end, of which the summary is the mark."""
        return (self.directory / "summary.json").exists()


@contextlib.contextmanager
def connected(address: str, cpus: float, gpus: float) -> Iterator[None]:
    """Connect to a Ray cluster, or start Ray on this machine, for the duration of the block.

    Args:
        address: Address of the cluster, or ``"local"``.
        cpus: Cores per job.
        gpus: GPUs per job.

    Raises:
        ValueError: If this machine is too small for a job.
        ConnectionError: If there is no such cluster.
        ImportError: If Ray is not installed.
    """
    try:
        import ray  # here, since --help does not need it
    except ImportError:
        raise ImportError(
            "sweeps run on Ray, which is not installed: pip install 'bgpo_trl[ray]'"
        ) from None
    # Disables Ray's usage reports, and the niceness that it gives to workers.
    os.environ.update(RAY_USAGE_STATS_ENABLED="0", RAY_worker_niceness="0")
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR}
    if address == "local":
        # Jobs pass no data between processes, so the smallest object store suffices.
        options |= {"include_dashboard": False, "object_store_memory": 80_000_000}
    try:
        ray.init(address, **options)
        for name, wanted in (("cpu", cpus), ("gpu", gpus)):
            available = ray.cluster_resources().get(name.upper(), 0)
            if address == "local" and wanted > available:
                raise ValueError(f"--{name}s-per-run {wanted:g}: Ray finds {available:g} here")
        yield
    finally:
        ray.shutdown()


def work(job: Job, play: Callable[[Job], None], command: Sequence[str]) -> None:
    """Run a job in a worker unless it is finished, with its output in the job's ``log.txt``.

    Args:
        job: The job.
        play: Function that runs it.
        command: Value for ``sys.argv``, which Ray sets otherwise in a worker.
    """
    sys.argv = list(command)
    with (
        lock_directory(job.directory, wait=True),  # A worker that Ray lost may still be writing.
        open(job.directory / "log.txt", "a", buffering=1) as log,
        contextlib.redirect_stdout(log),
        contextlib.redirect_stderr(log),
    ):
        if job.finished:
            return
        log.write(f"{time.strftime('%F %T')} process {os.getpid()} on {socket.gethostname()}\n")
        try:
            play(job)
        except BaseException:
            traceback.print_exc()
            raise


def play_jobs(
    jobs: Sequence[Job], play: Callable[[Job], None], *, cpus: float = 1, gpus: float = 0
) -> dict[Job, str]:
    """Run jobs on the connected Ray cluster, with a progress bar.

    Args:
        jobs: The jobs.
        play: Function called in a worker, which resumes a job and returns at its end.
        cpus: Cores per job.
        gpus: GPUs per job.

    Returns:
        The failed jobs, each with a one-line reason: ``play`` raised, or its worker was lost
        repeatedly.

    Raises:
        KeyboardInterrupt: On Ctrl-C, which is passed on to ``play``; it has a minute to save.
    """
    import ray
    from ray.exceptions import RayError

    # Workers import modules beside `play`, from this package and, of own tasks, from here.
    folders = [Path(inspect.getfile(play)).resolve().parent, Path(__file__).resolve().parents[2]]
    folders.append(Path.cwd())
    path = [*map(str, folders), os.environ.get("PYTHONPATH", "")]
    environment = {"PYTHONPATH": os.pathsep.join(filter(None, path)), "OMP_NUM_THREADS": "1"}
    task = ray.remote(
        num_cpus=cpus,
        num_gpus=gpus,
        max_retries=RETRIES,  # for lost workers or machines, not for jobs that raise
        max_calls=1,  # one process per job
        runtime_env={"env_vars": environment},
    )(work)
    pending = {task.remote(job, play, sys.argv): job for job in jobs}
    failed: dict[Job, str] = {}
    total = sum(map(_planned_episodes, jobs))
    with progress_bar("sweep", total=total, initial=_episodes(jobs), unit="episode") as bar:
        try:
            while pending:
                for ended in ray.wait(list(pending), timeout=10)[0]:
                    job = pending.pop(ended)
                    try:
                        ray.get(ended)
                    except RayError as error:
                        failed[job] = _reason(error)
                    bar.write(f"{job}: {'failed' if job in failed else 'finished'}")
                bar.update(_episodes(jobs) - bar.n)
        except KeyboardInterrupt:
            for reference in pending:
                ray.cancel(reference)
            ray.wait(list(pending), num_returns=len(pending), timeout=60)
            raise
    return failed


def _planned_episodes(job: Job) -> int:
    """Return the number of training episodes of a run and of test episodes between them."""
    config = job.config
    evaluations = range(config.eval_every, config.episodes + 1, config.eval_every)
    tested = sum(start < episode for episode in evaluations for start in config.task_starts)
    return len(config.seeds) * (config.episodes + config.eval_episodes * tested)


def _episodes(jobs: Iterable[Job]) -> int:
    """Return the number of these episodes on record."""
    files = (job.directory / name for job in jobs for name in CSV_FILES)
    return sum(max(0, path.read_bytes().count(b"\n") - 1) for path in files if path.exists())


def _reason(error: Exception) -> str:
    cause = getattr(error, "cause", None) or error
    return f"{type(cause).__name__}: {(str(cause).splitlines() or [''])[0]}"
