"""One run of the paper's experiments, from the encoders to the figures."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from shlex import quote

import torch
from torchrl.record.loggers.common import Logger

from bgpo_trl.algorithms import Algorithm
from bgpo_trl.configs import STAGE_PRESETS, RunConfig
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.encoders.pretrained import load_pretrained, weights_of_bank
from bgpo_trl.encoders.representation import Representation
from bgpo_trl.encoders.train import make_pretrained
from bgpo_trl.experiments.arguments import Arguments, BankArguments
from bgpo_trl.experiments.measure import draw, measure
from bgpo_trl.experiments.settings import (
    as_begun,
    changed_hyperparameters,
    chosen_scene,
    chosen_tasks,
    is_finished,
    named_directory,
)
from bgpo_trl.files.writing import lock_directory, write_json
from bgpo_trl.machine import choose_device, keep_freed_memory, set_threads
from bgpo_trl.plugins import import_plugin
from bgpo_trl.runs.config_file import read_config
from bgpo_trl.runs.dashboard import tensorboard_logger, wandb_logger
from bgpo_trl.runs.demonstrations import BANK, load_inputs, own_weights
from bgpo_trl.runs.directory import holds_run
from bgpo_trl.runs.growth import Distinctness, Grown, add_task, distinctness
from bgpo_trl.runs.provenance import command, commit_of_code, versions
from bgpo_trl.scenes import Scene, find_scene
from bgpo_trl.training import Trainer

_DATASET, _ENCODERS = "demonstrations", "encoders"  # folders of a run that trains its encoders


def run_experiment(
    arguments: Arguments,
    name: str,
    config: RunConfig,
    make: Callable[..., Algorithm] | None = None,
) -> str:
    """Train to the end, run the final tests and draw the figures.

    In addition to the files of `Trainer`, the run directory gets ``final.csv`` (success and steps
    of the trained policies with demonstrations seen in training and with held-out ones, and task
    inference), ``gwr.csv`` (nodes of the first seed's GWR-B), ``figures/`` (including a video of a
    test episode of each task; also on dashboards) and finally ``summary.json`` (commit,
    versions of packages, changed hyperparameters, command, success of a random policy, nodes of
    GWR-B, groups of behaviors).

    Args:
        arguments: Arguments of the command line.
        name: Name of the experiment, for the run directory.
        config: Settings of the run.
        make: Factory of the algorithm; by default the one registered as ``config.name``.

    Returns:
        Results to print, with the path of the run directory.

    Raises:
        ValueError: If the directory holds another run, or no run to resume; or if ``bank`` or
            ``encoders`` are given although encoders are yet to be trained.
        BlockingIOError: If another process is using the directory.
    """
    if arguments.train_encoders and (arguments.bank or arguments.encoders):
        raise ValueError(
            "--bank and --encoders name what is there: leave them or --train-encoders out"
        )
    if not config.eval_episodes:
        raise ValueError(
            "this command draws figures of tests: set eval_episodes to at least 1, or train "
            "without tests with Trainer (examples/own_robot.py)"
        )
    if arguments.add_task is not None and (
        not arguments.resume or arguments.train_encoders or arguments.encoders
    ):
        raise ValueError(
            "--add-task: name a run with --resume and --out, without --encoders and "
            "--train-encoders, since it keeps its own"
        )
    commit = commit_of_code()  # read first, since commits may follow during training
    set_threads(arguments.threads)
    keep_freed_memory()
    device = choose_device(arguments.device)
    size = arguments.preset or (arguments.config.stem if arguments.config else "quick")
    group = f"{name}-{config.name}"
    out = named_directory(arguments) or Path("runs") / f"{group}-{size}"
    grown: Grown | None = None
    seen: Distinctness | None = None
    loggers = _loggers(arguments, config, out, group, size)
    if arguments.resume:
        config = _continued(arguments, config, out)
        if arguments.add_task is not None:
            grown = add_task(out, arguments.add_task, config=config, bank=arguments.bank)
            config, seen = grown.config, distinctness(grown.bank)
            if not seen.clear:
                warnings.warn(f"{arguments.add_task}: {seen}", stacklevel=2)
        elif is_finished(out, config):
            return f"{out} is finished, all {config.episodes} episodes: --episodes makes it longer"
    elif holds_run(out):
        raise ValueError(f"{out} holds a run: --resume continues it, --out names another directory")
    with lock_directory(out):
        if grown is None:
            encoders, bank = _encoders(arguments, config, out, device)
        else:
            encoders, bank = grown.encoders, grown.bank
        with Trainer(
            config,
            out,
            bank=bank,
            encoders=encoders,
            make=make,
            device=device,
            resume=arguments.resume,
            loggers=loggers,
            per_seed_curves=arguments.per_seed_curves,
        ) as trainer:
            trainer.run()
            code = {"commit": commit, "versions": versions()}
            changed = changed_hyperparameters(config)
            summary = {**code, "changed": changed, **measure(trainer, bank, out)}
            lines = draw(trainer, bank, out, summary)
            for path in sorted((out / "figures").iterdir()):
                trainer.dashboard.log_media(f"figures/{path.stem}", path)
            # Written last, as the mark of a complete run.
            write_json(out / "summary.json", summary)
    if seen is not None:
        lines.append(f"{arguments.add_task}: {seen}")
    lines.append(f"curve and figures: {out}; in numbers: bgpo report {quote(str(out))}")
    return "\n".join(lines)


def _loggers(
    arguments: Arguments, config: RunConfig, out: Path, group: str, size: str
) -> list[Callable[[], Logger]]:
    """Return functions that make the loggers of the command line."""
    loggers: list[Callable[[], Logger]] = []
    if arguments.wandb is not None:
        # Without --preset or --config, the size of a run that is resumed is its own.
        sized = arguments.preset or arguments.config or not holds_run(out)
        tags = (config.name, config.schedule, size) if sized else None
        group = arguments.wandb_group or group
        loggers.append(partial(wandb_logger, out, arguments.wandb, group=group, tags=tags))
    if arguments.tensorboard:
        loggers.append(partial(tensorboard_logger, out))
    return loggers


def _bank(arguments: Arguments, out: Path) -> Path | None:
    """Return the bank of the command line or, when resuming, that of the run directory."""
    kept = out / BANK
    return kept if arguments.bank is None and arguments.resume and kept.exists() else arguments.bank


def _makes_encoders(arguments: Arguments, out: Path) -> bool:
    # A bank fits the encoders that embedded it alone.
    given = arguments.encoders is not None or _bank(arguments, out) is not None
    return arguments.train_encoders or (arguments.preset in STAGE_PRESETS and not given)


def _continued(arguments: Arguments, config: RunConfig, out: Path) -> RunConfig:
    """Return the settings with which the run in a directory continues, or begins.

    Raises:
        ValueError: If the directory holds the beginning of new encoders that are not asked for.
    """
    begun = any((out / folder).exists() for folder in (_DATASET, _ENCODERS))
    if begun and not holds_run(out) and not _makes_encoders(arguments, out):
        raise ValueError(
            f"{out} holds the beginning of new encoders: add --train-encoders, or name another "
            "directory"
        )
    continued = as_begun(config, out, keep_eval_every=arguments.gives("eval_every"))
    if arguments.gives("task_starts"):  # the run's, or `Trainer` refuses them
        continued = replace(continued, task_starts=config.task_starts)
    return continued


def _encoders(
    arguments: Arguments, config: RunConfig, out: Path, device: torch.device
) -> tuple[Representation, DemonstrationBank]:
    """Return the pretrained encoders and a bank, or new ones made in the run directory."""
    begun = arguments.resume and arguments.bank is None and (out / "config.json").exists()
    scene, own = find_scene(config.scene), own_weights(out)
    if begun:
        return load_inputs(out, config.tasks, read_config(out / "config.json")[1], scene)
    if not _makes_encoders(arguments, out):
        bank = _bank(arguments, out)
        return pretrained_for(config.tasks, bank, scene=scene, weights=arguments.encoders)
    stage = STAGE_PRESETS.get(arguments.preset or "")
    encoders, bank = make_pretrained(
        own,
        out / _DATASET,
        folder=out / _ENCODERS,
        command=command(),
        device=device,
        tasks=config.tasks,
        spread=config.spread,
        scene=scene,
        **({} if stage is None else vars(stage)),
    )
    return encoders, bank.for_tasks(config.tasks)


def pretrained_for(
    tasks: Sequence[str],
    bank: Path | None = None,
    *,
    scene: Scene | str = "nico",
    weights: Path | None = None,
) -> tuple[Representation, DemonstrationBank]:
    """Load trained encoders and the demonstrations of some tasks.

    Args:
        tasks: Names of the tasks.
        bank: Bank to take them from; those that it lacks are taken from the one beside the
            encoders.
        scene: The robot, or its name.
        weights: File of the encoders; by default those that come with the scene, for the bank if
            there is one.

    Raises:
        ValueError: If a file is missing, damaged or of other encoders, no encoders come with the
            scene, or a task has no demonstrations.
    """
    if weights is None and bank is not None:
        weights = weights_of_bank(bank, scene)
    encoders, found = load_pretrained(weights, tasks=tasks, scene=scene)
    if bank is not None:
        own = DemonstrationBank.load(bank, encoder_id=encoders.identity)
        lacking = [task for task in tasks if task not in own.tasks]
        found = own + found.for_tasks(lacking) if lacking else own
    return encoders, found.for_tasks(tasks)


def bank_of(arguments: BankArguments) -> DemonstrationBank:
    """Load the demonstrations that a command line names, embedded by trained encoders.

    Raises:
        ValueError: As for `import_plugin`, `chosen_scene`, `chosen_tasks` and `pretrained_for`.
    """
    import_plugin(arguments.module)
    scene = chosen_scene(arguments.scene)
    tasks = chosen_tasks(arguments.tasks, scene)
    return pretrained_for(tasks, arguments.bank, scene=scene, weights=arguments.encoders)[1]
