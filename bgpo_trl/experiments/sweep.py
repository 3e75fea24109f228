"""Sweeps on Ray: algorithms in settings over many seeds, in blocks of seeds.

    bgpo sweep --algorithms bgpo maml dist-nll --settings concurrent continual \
        --seeds 0 1 2 3 4 5 6 7 8 9 --block 5 --preset desk

runs twelve jobs, as many at a time as there are cores. A job is a block of seeds of one algorithm
in one setting, with a run directory such as ``runs/sweep/concurrent-bgpo/seeds-0-1-2-3-4``.
``bgpo report runs/sweep`` joins the blocks.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from bgpo_trl.algorithms import ABLATIONS
from bgpo_trl.configs import RunConfig
from bgpo_trl.experiments.arguments import Arguments, Setting, SweepArguments
from bgpo_trl.experiments.ray_jobs import Job, connected, play_jobs
from bgpo_trl.experiments.run import pretrained_for, run_experiment
from bgpo_trl.experiments.settings import run_config
from bgpo_trl.plugins import import_plugin
from bgpo_trl.runs.config_file import Digests, settings_of
from bgpo_trl.runs.directory import check_settings, holds_run
from bgpo_trl.scenes import find_scene
from suites import opengl


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


def play(job: Job) -> None:
    """Play a job to its end, from its last checkpoint if there is one."""
    import_plugin(job.module)
    arguments = Arguments(
        out=job.directory, resume=holds_run(job.directory), bank=job.bank, encoders=job.encoders
    )
    run_experiment(arguments, "sweep", job.config)


def sweep(arguments: SweepArguments) -> str:
    """Run the jobs of a grid that are not finished.

    Raises:
        ValueError: If the settings are invalid, or a directory holds another run.
        RuntimeError: If a job fails, such as on a full disk, after the others have finished.
    """
    import_plugin(arguments.module)
    jobs = make_jobs(arguments)
    digests = {
        config.tasks: Digests(
            *(
                part.identity
                for part in pretrained_for(
                    config.tasks,
                    arguments.bank,
                    scene=config.scene,
                    weights=arguments.encoders,
                )
            )
        )
        for config in (group[0].config for group in jobs.values())
    }
    check_directories(jobs, digests)
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
