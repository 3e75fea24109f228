"""Sweeps on Ray: algorithms in settings over many seeds, in blocks of seeds.

    bgpo sweep --algorithms bgpo maml dist-nll --settings concurrent continual \
        --seeds 0 1 2 3 4 5 6 7 8 9 --block 5 --preset desk

runs twelve jobs, as many at a time as there are cores. A job is a block of seeds of one algorithm
in one setting, with a run directory such as ``runs/sweep/concurrent-bgpo/seeds-0-1-2-3-4``. Each is
run to its end exactly once, even if workers are lost. ``bgpo report runs/sweep`` joins the blocks.
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
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bgpo_trl.algorithms import ABLATIONS
from bgpo_trl.configs import RunConfig
from bgpo_trl.experiments.arguments import Arguments, Setting, SweepArguments
from bgpo_trl.experiments.run import pretrained_for, run_experiment
from bgpo_trl.experiments.settings import run_config
from bgpo_trl.files.progress import progress_bar
from bgpo_trl.files.writing import lock_directory
from bgpo_trl.plugins import import_plugin
from bgpo_trl.runs.config_file import Digests, settings_of
from bgpo_trl.runs.directory import check_settings, holds_run
from bgpo_trl.scenes import find_scene
from suites import opengl

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


def make_jobs(arguments: SweepArguments) -> dict[Path, list[Job]]:
    """Return the jobs of the grid, by the folder of their directories.

    Raises:
        ValueError: If the settings are invalid, or the grid is empty.
    """
    if arguments.block < 1:
        raise ValueError(f"block must be at least 1, got {arguments.block}")
    if arguments.cpus_per_run <= 0 or arguments.gpus_per_run < 0:
        raise ValueError("--cpus-per-run must be above 0 and --gpus-per-run at least 0")
    ablation = [name for name in ABLATIONS if not name.startswith("bgpo")]
    jobs: dict[Path, list[Job]] = {}
    for setting in arguments.settings:
        for name in ablation if setting == "ablation" else arguments.algorithms:
            config = _config(arguments, setting, name)
            folder = arguments.out.absolute() / f"{setting}-{name}"
            blocks = [
                config.seeds[first : first + arguments.block]
                for first in range(0, len(config.seeds), arguments.block)
            ]
            bank, encoders = (
                None if path is None else path.absolute()
                for path in (arguments.bank, arguments.encoders)
            )
            jobs[folder] = [
                Job(
                    folder / "-".join(["seeds", *map(str, block)]),
                    replace(config, seeds=block),
                    module=arguments.module,
                    bank=bank,
                    encoders=encoders,
                )
                for block in blocks
            ]
    if not jobs:
        raise ValueError("name at least one of --algorithms and one of --settings")
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


def check_directories(
    jobs: dict[Path, list[Job]], digests: Mapping[tuple[str, ...], Digests]
) -> None:
    """Check that the directories of the jobs hold no other runs.

    Args:
        jobs: Result of `make_jobs`.
        digests: Digests of the encoders and demonstrations, by the tasks of a job.

    Raises:
        ValueError: If a directory holds another run.
    """
    for folder, group in jobs.items():
        if (folder / "config.json").exists():
            raise ValueError(f"{folder} is not a run of a sweep: choose another --out")
        for job in group:
            check_settings(job.directory, settings_of(job.config, digests[job.config.tasks]))


def _digests(job: Job) -> Digests:
    """Return the digests of the encoders and demonstrations of a job."""
    config = job.config
    found = pretrained_for(config.tasks, job.bank, scene=config.scene, weights=job.encoders)
    return Digests(*(part.identity for part in found))


def play(job: Job) -> None:
    """Play a job to its end, from its last checkpoint if there is one."""
    import_plugin(job.module)
    arguments = Arguments(
        out=job.directory, resume=holds_run(job.directory), bank=job.bank, encoders=job.encoders
    )
    run_experiment(arguments, "sweep", job.config)


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
    total = sum(len(job.config.seeds) * job.config.episodes for job in jobs)
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


def _episodes(jobs: Iterable[Job]) -> int:
    """Return the number of training episodes on record."""
    files = (job.directory / "train.csv" for job in jobs)
    return sum(path.read_bytes().count(b"\n") - 1 for path in files if path.exists())


def _reason(error: Exception) -> str:
    cause = getattr(error, "cause", None) or error
    return f"{type(cause).__name__}: {(str(cause).splitlines() or [''])[0]}"


def sweep(arguments: SweepArguments) -> str:
    """Run the jobs of a grid that are not finished.

    Raises:
        ValueError: If the settings are invalid, or a directory holds another run.
        RuntimeError: If a job fails, such as on a full disk, after the others have finished.
    """
    import_plugin(arguments.module)
    jobs = make_jobs(arguments)
    check_directories(jobs, {g[0].config.tasks: _digests(g[0]) for g in jobs.values()})
    todo = [job for group in jobs.values() for job in group if not job.finished]
    failed: dict[Job, str] = {}
    if todo:
        if arguments.address == "local":  # The machines of a cluster are not this one.
            opengl.check()
        resources = {"cpus": arguments.cpus_per_run, "gpus": arguments.gpus_per_run}
        try:
            with connected(arguments.address, **resources):
                failed = play_jobs(todo, play, **resources)
        except KeyboardInterrupt:
            sys.exit("interrupted: the same command continues")
    if failed:
        raise RuntimeError("; ".join(f"{job} failed: {why}" for job, why in failed.items()))
    return f"jobs: {sum(map(len, jobs.values()))}, run: {len(todo)}; bgpo report {arguments.out}"
