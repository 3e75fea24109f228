"""Plays algorithms in settings over many seeds on Ray, and merges what the blocks of seeds leave.

    python benchmarks/sweep.py --algorithms bgpo maml dist-nll --settings concurrent continual \
        --seeds 0 1 2 3 4 5 6 7 8 9 --block 5 --preset desk

plays twelve jobs, as many at a time as there are cores. A job is a block of seeds of one algorithm
in one setting, with a run directory such as ``runs/sweep/concurrent-bgpo/seeds-0-1-2-3-4``. When
all blocks are there, they are merged into ``runs/sweep/concurrent-bgpo``, which holds what one run
of all seeds would: ``python benchmarks/report.py runs/sweep`` reads it.

Whatever ended a sweep, the same command goes on from where it was, and plays nothing twice; seeds
may be added. A job whose worker or machine is lost goes on elsewhere from its last checkpoint. One
that fails by itself (a full disk, a damaged file) is told at the end, when the others are played.

On a cluster (``--address auto`` on one of its machines, or ``HOST:6379``) all machines need Ray,
and bgpo_trl with what it depends on; and this checkout and ``--out`` at the same path of a file
system that they share. Locks on files must hold across machines, as they do on NFS.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from bgpo_trl.algorithms import ABLATIONS
from bgpo_trl.encoders.pretrained import load_pretrained
from bgpo_trl.experiments import run as experiment
from bgpo_trl.experiments.merge import merge
from bgpo_trl.files.locking import DirectoryLock
from bgpo_trl.runs.config_file import settings_of
from bgpo_trl.runs.directory import check_settings, holds_run
from bgpo_trl.runs.results import read_json

try:
    from bgpo_trl.experiments.ray_jobs import Job, connected, play_jobs
except ImportError as error:
    sys.exit(f"error: {error}")


@dataclass(frozen=True)
class Arguments:
    """Plays a grid of runs on Ray."""

    algorithms: tuple[experiment.AlgorithmName, ...] = ("bgpo",)
    """What learns; see concurrent.py."""
    settings: tuple[Literal["concurrent", "continual", "ablation"], ...] = ("concurrent",)
    """All tasks from the start; one after the other; or BGPO without GWR-B, without the intrinsic
    reward and without both, whatever the algorithms are."""
    preset: Literal["quick", "desk", "paper"] = "desk"
    """Size of the runs."""
    seeds: tuple[int, ...] | None = None
    """Other seeds than the preset's."""
    block: int = 5
    """Seeds that are played as one run. Another number makes other runs."""
    episodes: int | None = None
    """Another length than the preset's; the tasks' starts keep their proportions."""
    out: Path = Path("runs/sweep")
    """Holds the runs."""
    address: str = "local"
    """Of a Ray cluster; "local" starts Ray on this machine alone."""
    cpus_per_run: float = 1
    """Cores that Ray counts for a run."""
    gpus_per_run: float = 0
    """GPUs that Ray gives to a run, or a share of one; networks are on the CPU without."""


def make_jobs(arguments: Arguments) -> dict[Path, list[Job]]:
    """Returns the jobs of the grid, by the directory that they are merged into.

    Raises:
        ValueError: If there is no such run, or nothing to play.
    """
    if arguments.block < 1:
        raise ValueError(f"block must be at least 1, got {arguments.block}")
    if arguments.cpus_per_run <= 0 or arguments.gpus_per_run < 0:
        raise ValueError("--cpus-per-run must be above 0, and --gpus-per-run not below")
    jobs: dict[Path, list[Job]] = {}
    for setting in arguments.settings:
        # Those that are not an algorithm by a name of its own.
        ablation = [v for v in ABLATIONS if v not in ("gwr+r_int", "experts", "all")]
        for name in ablation if setting == "ablation" else arguments.algorithms:
            config = experiment.run_config(
                experiment.Arguments(
                    algorithm="bgpo" if setting == "ablation" else name,
                    preset=arguments.preset,
                    seeds=arguments.seeds,
                    episodes=arguments.episodes,
                )
            )
            starts = config.task_starts if setting == "continual" else (0, 0, 0)
            config = replace(config, name=name, task_starts=starts)
            if setting == "ablation":
                config = replace(config, algorithm=ABLATIONS[name].config)
            merged = arguments.out.absolute() / f"{setting}-{name}"
            blocks = [
                config.seeds[first : first + arguments.block]
                for first in range(0, len(config.seeds), arguments.block)
            ]
            jobs[merged] = [
                Job(merged / "-".join(["seeds", *map(str, block)]), replace(config, seeds=block))
                for block in blocks
            ]
    if not jobs:
        raise ValueError("name at least one of --algorithms and one of --settings")
    return jobs


def check_directories(jobs: dict[Path, list[Job]], encoders: str) -> None:
    """Makes sure that whatever is in the directories of the jobs belongs there.

    Args:
        jobs: From `make_jobs`.
        encoders: Identity of the encoders that the runs use.

    Raises:
        ValueError: If one of them holds something else.
    """
    for merged, group in jobs.items():
        for job in group:
            check_settings(job.directory, settings_of(job.config, encoders))
        path = merged / "config.json"
        if path.exists():  # merged before, from the same blocks or others
            if not any(merged.glob("seeds-*")):
                raise ValueError(f"{merged} is a run of its own: choose another --out")
            seeds = read_json(path)["seeds"]
            settings = {**settings_of(group[0].config, encoders), "seeds": seeds}
            check_settings(merged, settings)


def play(job: Job) -> None:
    """Plays a job to its end, from its last checkpoint if there is one, and measures."""
    arguments = experiment.Arguments(out=job.directory, resume=holds_run(job.directory))
    experiment.run_experiment(arguments, "sweep", job.config)


def main(arguments: Arguments) -> None:
    """Plays what is not finished, and merges what is."""
    jobs = make_jobs(arguments)
    check_directories(jobs, load_pretrained()[0].identity)
    todo = [job for group in jobs.values() for job in group if not job.finished]
    print(f"{sum(map(len, jobs.values()))} jobs, {len(todo)} of them to play")
    failed: dict[Job, str] = {}
    if todo:
        resources = {"cpus": arguments.cpus_per_run, "gpus": arguments.gpus_per_run}
        try:
            with connected(arguments.address, **resources):
                failed = play_jobs(todo, play, **resources)
        except KeyboardInterrupt:
            sys.exit("interrupted: the same command continues")
    for directory, group in jobs.items():
        if failed.keys().isdisjoint(group):
            with DirectoryLock(directory, wait=True):
                merge([job.directory for job in group], directory)
            print(f"{directory}: {len(group)} blocks of seeds")
    if failed:
        sys.exit("\n".join(f"error: {job} failed: {why}" for job, why in failed.items()))


if __name__ == "__main__":
    experiment.command_line(main, __doc__, Arguments)
