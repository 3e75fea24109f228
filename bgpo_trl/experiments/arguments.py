"""Command line of the experiments: its arguments, and the settings of a run that they stand for."""

from __future__ import annotations

import os
import shlex
import sys
import sysconfig
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import tyro

from bgpo_trl.algorithms import ALGORITHMS
from bgpo_trl.algorithms.rl import RL
from bgpo_trl.configs import PRESETS, RunConfig
from bgpo_trl.configs.checks import check_seeds
from bgpo_trl.encoders.pretrained import default_weights, weights_of_bank
from bgpo_trl.plugins import import_plugin
from suites import nico

_Entry = TypeVar("_Entry")


@dataclass(frozen=True, kw_only=True)
class ImportArguments:
    """Own tasks and algorithms in a command."""

    module: Annotated[str | None, tyro.conf.arg(name="import")] = None
    """Module that adds tasks (nico.add_task) or algorithms (ALGORITHMS), imported first; here or
    installed."""


@dataclass(frozen=True, kw_only=True)
class BankArguments(ImportArguments):
    """Tasks and their demonstrations."""

    tasks: tuple[str, ...] | None = None
    """Tasks in the order of presentation, or "all" for the suite's eight; the paper's three by
    default."""
    bank: Path | None = None
    """Demonstrations embedded by bgpo_trl.encoders.make_bank; for tasks missing in it, the
    package's are used."""


@dataclass(frozen=True, kw_only=True)
class TaskArguments(BankArguments):
    """Tasks of a run."""

    tasks: tuple[str, ...] | None = None
    """Tasks in the order of presentation, or "all" for the suite's eight; the paper's three by
    default. Unless there are three, they start at even intervals."""


@dataclass(frozen=True)
class Arguments(TaskArguments):
    """Train an algorithm and plot its success."""

    bank: Path | None = None
    """Demonstrations embedded by bgpo_trl.encoders.make_bank; for tasks missing in it, the
    package's are used. With --resume, the run's own by default."""

    algorithm: str = "bgpo"
    """bgpo; bgpo-experts: without demonstrations as experience; bgpo-single: without experts too;
    maml and dist-nll: the baselines, alone or followed by -demonstrations; bgpo-paper, maml-paper,
    dist-nll-paper: as published; oracle and ddpg: DDPG with the task label as context, and without
    context; or one that the module of --import adds."""
    rl: str | None = None
    """The RL algorithm of BGPO, its ablations and the references: ddpg, td3, sac, or one that the
    module of --import adds; DDPG by default."""
    preset: Literal["smoke", "quick", "desk", "paper"] = "quick"
    """Size of the run, with its time on two cores: smoke (12 episodes of 2 seeds, every stage in 2
    minutes), quick (1,200 episodes of 2 seeds, 20 minutes), desk (6,000 episodes of 5 seeds, some
    five hours) or paper (20,000 episodes of 10 seeds, days)."""
    out: Path | None = None
    """Run directory; runs/EXPERIMENT-ALGORITHM[-RL]-PRESET by default."""
    seeds: tuple[int, ...] | None = None
    """Seeds; the preset's by default."""
    schedule: Literal["practised", "sequential"] = "practised"
    """Tasks of training episodes: all presented so far (practised) or only the newest (sequential,
    as in Continual World and COOM)."""
    spread: float = 1.0
    """Share of the whole range of start states, from 0 (nominal places) to 1."""
    episodes: int | None = None
    """Training episodes; the preset's by default. The task starts are scaled in proportion. With
    --resume, a larger number extends the run, whose task starts are kept."""
    eval_every: int | None = None
    """Training episodes between evaluations; the preset's by default."""
    held_out: Literal["validation", "test"] = "validation"
    """Half of the held-out demonstrations to test on: validation to choose settings, test to report
    results."""
    resume: bool = False
    """Continue the run in the directory, or begin it if there is none."""
    train_encoders: bool = False
    """Record demonstrations and train new encoders instead of using the pretrained ones."""
    wandb: Literal["online", "offline"] | None = None
    """Also log to Weights & Biases."""
    device: str = "auto"
    """Device of the networks: cpu, cuda, or auto for a GPU if there is one."""
    threads: int = 1
    """Threads of PyTorch; more than one slows these small networks down. Physics always uses all
    cores."""


def run_config(arguments: Arguments) -> RunConfig:
    """Return the preset of the continual setting, with the changes of the command line.

    Imports the module of own tasks first.

    Raises:
        ValueError: If the settings are invalid, or a task or algorithm does not exist.
    """
    import_plugin(arguments.module)
    config = _with_tasks(PRESETS[arguments.preset], arguments.tasks)
    algorithm = chosen(ALGORITHMS, arguments.algorithm, "--algorithm").config
    rl = algorithm.rl.name if arguments.rl is None else arguments.rl
    if rl != algorithm.rl.name:
        other = chosen(RL, rl, "--rl").config
        if arguments.algorithm.endswith("-paper"):
            raise ValueError(f"--rl: {arguments.algorithm} uses DDPG, as published: leave --rl")
        algorithm = replace(algorithm, rl=other)
    config = replace(
        config,
        name=arguments.algorithm,
        algorithm=algorithm,
        held_out=arguments.held_out,
        schedule=arguments.schedule,
        spread=arguments.spread,
    )
    if arguments.seeds is not None:
        config = replace(config, seeds=arguments.seeds)
    if arguments.episodes is not None:
        share, last = arguments.episodes / config.episodes, arguments.episodes - 1
        starts = tuple(min(round(start * share), last) for start in config.task_starts)
        config = replace(
            config,
            episodes=arguments.episodes,
            task_starts=starts,
            eval_every=max(1, min(config.eval_every, arguments.episodes)),
        )
    if arguments.eval_every is not None:
        config = replace(config, eval_every=arguments.eval_every)
    if config.eval_every > config.episodes:
        raise ValueError(
            f"eval_every must be at most the {config.episodes} episodes of the run, got "
            f"{config.eval_every}: its tests are its results"
        )
    return config


def chosen(entries: Mapping[str, _Entry], name: str, flag: str) -> _Entry:
    """Return the entry that a flag names.

    Raises:
        ValueError: If there is none of that name.
    """
    if name not in entries:
        raise ValueError(
            f"{flag}: there is no {name!r}; name one of {', '.join(entries)}, or with --import "
            "MODULE one that a module adds"
        )
    return entries[name]


def chosen_weights(tasks: Sequence[str], bank: Path | None) -> Path:
    """Return the path of the shipped encoders for some tasks, or those that embedded a bank."""
    return default_weights(tasks) if bank is None else weights_of_bank(bank)


def at_once(config: RunConfig) -> RunConfig:
    """Return a run whose tasks are all presented from the start."""
    return replace(config, task_starts=(0,) * len(config.tasks))


def chosen_tasks(tasks: tuple[str, ...] | None, default: tuple[str, ...]) -> tuple[str, ...]:
    """Return the tasks that ``--tasks`` names.

    Raises:
        ValueError: If it is empty or a task does not exist.
    """
    if tasks is None:
        return default
    if tasks == ("all",):
        return nico.ALL_TASKS
    unknown = [name for name in tasks if name not in nico.TASKS]
    if unknown or not tasks:
        wrong = f"there is no task {unknown[0]!r}" if unknown else "it is empty"
        raise ValueError(
            f"--tasks: {wrong}; name some of {', '.join(nico.TASKS)}, or with --import MODULE some "
            "that a module adds"
        )
    return tasks


def _with_tasks(config: RunConfig, chosen: tuple[str, ...] | None) -> RunConfig:
    """Return a preset with other tasks."""
    tasks = chosen_tasks(chosen, config.tasks)
    same = len(tasks) == len(config.task_starts)
    starts = config.task_starts if same else even_starts(len(tasks), config.episodes)
    return replace(config, tasks=tasks, task_starts=starts)


def check_draws(seeds: Sequence[int], draws: int) -> None:
    """Raise ``ValueError`` if there is nothing to draw, or seeds are missing or repeated."""
    if draws < 1:
        raise ValueError(f"--draws must be at least 1, got {draws}")
    check_seeds(seeds)


def even_starts(n_tasks: int, episodes: int) -> tuple[int, ...]:
    """Return the episodes from which tasks are presented at even intervals."""
    return tuple(position * episodes // n_tasks for position in range(n_tasks))


def command_line(
    main: Callable[[Any], None],
    description: str | None,
    arguments: type = Arguments,
    options: Sequence[str] | None = None,
) -> None:
    """Run ``main`` with the arguments of the command line; an expected error becomes one line.

    Ctrl-C and SIGTERM exit with 75 (``os.EX_TEMPFAIL``) if ``--resume`` can continue. An error of
    somebody else's code, such as a module named with ``--import``, keeps its traceback.

    Args:
        main: Called with the arguments.
        description: For ``--help``.
        arguments: Class of the arguments.
        options: Command line of a subcommand of ``python -m bgpo_trl``; that of the script if None.
    """
    program = None if options is None else shlex.join(["python", *sys.argv[:3]])
    try:
        kind: Any = Annotated[arguments, tyro.conf.OmitArgPrefixes]
        main(tyro.cli(kind, prog=program, description=description, args=options))
    except (ValueError, OSError, RuntimeError) as error:
        if _is_of_others(error):
            raise
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        if not hasattr(arguments, "resume"):
            sys.exit("interrupted")
        sys.stderr.write("interrupted: the same command with --resume continues\n")
        sys.exit(os.EX_TEMPFAIL)


def _is_of_others(error: BaseException) -> bool:
    """Return whether code raised an error, or called the library that did, which is not ours."""
    paths = [Path(frame.filename) for frame in traceback.extract_tb(error.__traceback__)]
    libraries = [Path(sysconfig.get_path(name)) for name in ("stdlib", "purelib", "platlib")]
    package = Path(__file__).parents[1]
    ours = [package, package.parent / "suites", package.parent / "benchmarks"]
    for path in reversed(paths):
        if any(path.is_relative_to(folder) for folder in ours):
            return False
        if path.exists() and not any(path.is_relative_to(folder) for folder in libraries):
            return True
    return False
