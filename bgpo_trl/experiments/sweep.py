"""Sweeps on Ray: algorithms in settings over many seeds, in blocks of seeds.

A job is a block of seeds of one algorithm in one setting, with a run directory such as
``runs/sweep/concurrent-bgpo/seeds-0-1-2-3-4``. As many run at a time as there are cores.
``bgpo report runs/sweep`` joins the blocks.
"""

from __future__ import annotations

import contextlib
import inspect
import logging
import os
import socket
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bgpo_trl.algorithms import ABLATIONS
from bgpo_trl.configs import RunConfig
from bgpo_trl.experiments.arguments import Arguments, Setting, SweepArguments
from bgpo_trl.experiments.command_line import import_plugin
from bgpo_trl.experiments.run import check_inputs, run_experiment
from bgpo_trl.experiments.settings import run_config
from bgpo_trl.files.progress import progress_bar
from bgpo_trl.files.writing import lock_directory
from bgpo_trl.runs.config_file import read_config
from bgpo_trl.runs.directory import holds_run
from bgpo_trl.runs.results import is_finished
from bgpo_trl.scenes import find_scene
from suites import opengl

# Bounds the retries of a job that always crashes its worker.
RETRIES = 10


@dataclass(frozen=True, eq=False)  # Own hyperparameters may not be hashable.
class Job:
    """A run of a block of seeds."""

    directory: Path
    config: RunConfig
    arguments: Arguments = Arguments()  # noqa: RUF009, it is frozen
    """Its module of tasks or algorithms, its bank and encoders."""

    def __str__(self) -> str:
        return f"{self.directory.parent.name}/{self.directory.name}"

    @property
    def finished(self) -> bool:
        """Whether the job was run to its end."""
        return is_finished(self.directory, self.config.episodes)

    @property
    def episodes(self) -> int:
        """The number of training episodes on record."""
        path = self.directory / "train.csv"
        return path.read_bytes().count(b"\n") - 1 if path.exists() else 0


def make_jobs(arguments: SweepArguments) -> list[Job]:
    """Return the jobs of the grid.

    Raises:
        ValueError: If the settings are invalid, the grid is empty, or the directory of a job holds
            a run with other settings, encoders or demonstrations, or of another version of the
            scene.
    """
    if arguments.block < 1 or arguments.cpus_per_run <= 0 or arguments.gpus_per_run < 0:
        raise ValueError(
            "--block must be at least 1, --cpus-per-run above 0 and --gpus-per-run at least 0"
        )
    ablation = [name for name in ABLATIONS if not name.startswith("bgpo")]
    of_runs = {
        f"{setting}-{name}": _config(arguments, setting, name)
        for setting in arguments.settings
        for name in (ablation if setting == "ablation" else arguments.algorithms)
    }
    if not of_runs:
        raise ValueError("name at least one of --algorithms and one of --settings")
    bank, encoders = (
        None if path is None else path.absolute() for path in (arguments.bank, arguments.encoders)
    )
    files = Arguments(module=arguments.module, bank=bank, encoders=encoders)
    jobs: list[Job] = []
    for folder, config in of_runs.items():
        for first in range(0, len(config.seeds), arguments.block):
            block = config.seeds[first : first + arguments.block]
            directory = arguments.out.absolute() / folder / "-".join(["seeds", *map(str, block)])
            jobs.append(Job(directory, replace(config, seeds=block), files))
            path = directory / "config.json"
            if path.exists():
                saved, digests = read_config(path)
                if saved != jobs[-1].config:
                    raise ValueError(
                        f"{directory} holds a run with other settings: name another --out"
                    )
                check_inputs(files, saved, directory, digests)
    return jobs


def _config(arguments: SweepArguments, setting: Setting, name: str) -> RunConfig:
    """Return the settings of an algorithm's runs."""
    tasks = arguments.tasks
    if setting.startswith("eight"):
        if tasks is not None or arguments.scene not in (None, "nico"):
            raise ValueError(
                f"the setting {setting} has the eight tasks of NICO: leave --tasks and --scene out"
            )
        eight = find_scene("nico").all_tasks
        tasks = eight[::-1] if setting == "eight-reversed" else eight
    return run_config(
        Arguments(
            algorithm=name,
            preset=arguments.preset,
            episodes=arguments.episodes,
            scene=arguments.scene,
            tasks=tasks,
        ),
        from_start=setting.endswith(("concurrent", "ablation")),
        changes={
            "seeds": arguments.seeds,
            "eval_every": arguments.eval_every,
            "held_out": arguments.held_out,
            "schedule": "sequential" if setting.endswith("sequential") else "practised",
        },
    )


def play(job: Job) -> None:
    """Play a job to its end, from its last checkpoint if there is one."""
    import_plugin(job.arguments.module)
    resume = holds_run(job.directory)
    run_experiment(replace(job.arguments, out=job.directory, resume=resume), "sweep", job.config)


@contextlib.contextmanager
def connected(address: str, cpus: float, gpus: float) -> Iterator[None]:
    """Connect to a Ray cluster, or start Ray on this machine, during the block.

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
    """Run a job in a worker unless it is finished, with its output in the job's ``log.txt``."""
    sys.argv = list(command)  # which Ray sets otherwise
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

    ``play`` is called in a worker; it resumes a job and returns at its end.

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
    path = [*map(str, [*folders, Path.cwd()]), os.environ.get("PYTHONPATH", "")]
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
    total = sum(len(job.config.seeds) * job.config.episodes for job in jobs)
    played = sum(job.episodes for job in jobs)
    with progress_bar("sweep", total=total, initial=played, unit="episode") as bar:
        try:
            while pending:
                for ended in ray.wait(list(pending), timeout=10)[0]:
                    job = pending.pop(ended)
                    try:
                        ray.get(ended)
                    except RayError as error:
                        cause = getattr(error, "cause", None) or error
                        reason = (str(cause).splitlines() or [""])[0]
                        failed[job] = f"{type(cause).__name__}: {reason}"
                    bar.write(f"{job}: {'failed' if job in failed else 'finished'}")
                bar.update(sum(job.episodes for job in jobs) - bar.n)
        except KeyboardInterrupt:
            for reference in pending:
                ray.cancel(reference)
            ray.wait(list(pending), num_returns=len(pending), timeout=60)
            raise
    return failed


def sweep(arguments: SweepArguments) -> str:
    """Run the jobs of a grid that are not finished."""
    jobs = make_jobs(arguments)
    todo = [job for job in jobs if not job.finished]
    failed: dict[Job, str] = {}
    if todo:
        if arguments.address == "local":  # The machines of a cluster are not this one.
            opengl.check()
        cpus, gpus = arguments.cpus_per_run, arguments.gpus_per_run
        with connected(arguments.address, cpus, gpus):
            failed = play_jobs(todo, play, cpus=cpus, gpus=gpus)
    if failed:
        raise RuntimeError("; ".join(f"{job} failed: {why}" for job, why in failed.items()))
    return f"jobs: {len(jobs)}, run: {len(todo)}; bgpo report {arguments.out}"
