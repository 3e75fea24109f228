"""The paper's experiments: one run, from the encoders to the figures."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from shlex import quote

import torch
from torchrl.record.loggers.common import Logger

from bgpo_trl.configs import STAGE_PRESETS, RepresentationConfig, RunConfig
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.encoders.pretrained import load_pretrained, weights_of_bank
from bgpo_trl.encoders.probes import verdict_in
from bgpo_trl.encoders.representation import Representation, load_representation
from bgpo_trl.encoders.train import make_pretrained
from bgpo_trl.experiments.arguments import Arguments, BankArguments
from bgpo_trl.experiments.measure import draw, measure
from bgpo_trl.experiments.settings import (
    begun_with,
    changed_hyperparameters,
    chosen_tasks,
    named_directory,
    run_config,
)
from bgpo_trl.files.checkpoint import has_checkpoint
from bgpo_trl.files.writing import lock_directory, write_json
from bgpo_trl.logged import LoggedEpisodes
from bgpo_trl.machine import choose_device, keep_freed_memory, set_threads
from bgpo_trl.runs.config_file import Digests, read_config, read_encoder_settings
from bgpo_trl.runs.dashboard import check_installed, tensorboard_logger, wandb_logger
from bgpo_trl.runs.demonstrations import BANK, load_inputs, own_weights
from bgpo_trl.runs.directory import check_settings, holds_run
from bgpo_trl.runs.growth import Grown, add_task, distinctness
from bgpo_trl.runs.provenance import command, commit_of_code, versions
from bgpo_trl.runs.results import is_finished
from bgpo_trl.scenes import Scene, find_scene
from bgpo_trl.training import Trainer

_DATASET = "demonstrations"  # folder of a run that trains its encoders


def continual(arguments: Arguments) -> str:
    """Train an algorithm on tasks that are presented one after the other (Fig. 8)."""
    return run_experiment(arguments, "continual", run_config(arguments))


def concurrent(arguments: Arguments) -> str:
    """Train an algorithm on tasks that are all presented from the start (Figs. 6 and 9)."""
    return run_experiment(arguments, "concurrent", run_config(arguments, from_start=True))


def run_experiment(arguments: Arguments, name: str, config: RunConfig) -> str:
    """Train to the end, run the final tests and draw the figures.

    In addition to the files of `Trainer`, the run directory gets ``final.csv``, ``figures/`` and
    finally ``summary.json``, the mark of a complete run (docs/design.md).

    Raises:
        ValueError: If arguments do not go together, or the directory holds another run.
        BlockingIOError: If another process is using the directory.
    """
    _check(arguments, config)
    commit_of_code()  # of this moment, before encoders are made
    set_threads(arguments.threads)
    keep_freed_memory()
    device = choose_device(arguments.device)
    size = arguments.preset or (arguments.config.stem if arguments.config else "quick")
    group = f"{name}-{config.name}"
    out = named_directory(arguments) or Path("runs") / f"{group}-{size}"
    digests: Digests | None = None
    grown: Grown | None = None
    verdict, added = "", arguments.add_task
    if not arguments.resume and holds_run(out):
        raise ValueError(f"{out} holds a run: --resume continues it, --out names another directory")
    if arguments.resume and (out / "config.json").exists():
        saved, digests = read_config(out / "config.json")
        config = _continued(arguments, config, saved)
        if added is None and arguments.tasks and config.tasks != saved.tasks:
            raise ValueError(
                f"--tasks: {out} has the tasks {', '.join(saved.tasks)}: leave the flag out, or "
                "give it another one with --add-task"
            )
        if added in saved.tasks[-1:]:  # the same command once more; the run has the bank
            added, arguments = None, replace(arguments, bank=None)
        if added is None and saved == config and is_finished(out, config.episodes):
            check_inputs(arguments, config, out, digests)
            return f"{out} is finished, all {config.episodes} episodes: --episodes makes it longer"
        _check_encoders(arguments, out, digests)
    loggers: list[Callable[[], Logger]] = []
    if arguments.wandb is not None:
        check_installed("wandb")
        loggers.append(partial(wandb_logger, out, arguments.wandb, group))
    if arguments.tensorboard:
        check_installed("tensorboard")
        loggers.append(partial(tensorboard_logger, out))
    if added is not None:
        grown = add_task(out, added, config=config, bank=arguments.bank)
        config = grown.config
        clear, line = distinctness(grown.bank)
        verdict = f"{added}: {line}"
        if not clear:
            warnings.warn(verdict, stacklevel=2)
    with lock_directory(out):
        if grown is None:
            encoders, bank = _inputs(arguments, config, out, device, digests)
        else:
            encoders, bank = grown.encoders, grown.bank
        with Trainer(
            config,
            out,
            bank=bank,
            encoders=encoders,
            device=device,
            logged=arguments.logged,
            resume=arguments.resume,
            loggers=loggers,
        ) as trainer:
            trainer.run()
            changed = changed_hyperparameters(config)
            summary = {"versions": versions(), "changed": changed, **measure(trainer, bank, out)}
            lines = draw(trainer, bank, out, summary)
            # Written last, as the mark of a complete run.
            write_json(out / "summary.json", summary)
    lines += [verdict] if verdict else []
    if arguments.train_encoders:
        of_encoders = verdict_in(own_weights(out).parent, find_scene(config.scene))
        lines.append(f"its encoders:\n{of_encoders}")
    return "\n".join(
        [*lines, f"curve and figures: {out}; in numbers: bgpo report {quote(str(out))}"]
    )


def _check(arguments: Arguments, config: RunConfig) -> None:
    """Raise ``ValueError`` for arguments that do not go together."""
    if arguments.train_encoders and (arguments.bank or arguments.encoders):
        raise ValueError(
            "--bank and --encoders name what is there: leave them or --train-encoders out"
        )
    if arguments.encoder_settings is not None and not arguments.train_encoders:
        raise ValueError(
            "--encoder-settings: add --train-encoders, which trains encoders with them"
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


def _check_encoders(arguments: Arguments, out: Path, digests: Digests) -> None:
    """Raise ``ValueError`` if a run that has begun is to get encoders that it does not have."""
    if arguments.encoders is not None:
        found = load_representation(arguments.encoders).identity
        if found != digests.encoders:
            raise ValueError(
                f"--encoders: {out} was begun with the encoders {str(digests.encoders)[:12]}, not "
                f"with {arguments.encoders} ({found[:12]}): leave the flag out, or name another "
                "directory"
            )
    if arguments.train_encoders and not (own_weights(out).parent / "probes.json").exists():
        raise ValueError(f"--train-encoders: {out} was begun with encoders: leave the flag out")


def check_inputs(arguments: Arguments, config: RunConfig, out: Path, digests: Digests) -> None:
    """Raise ``ValueError`` if a run has other files than those named, or another scene version."""
    _check_encoders(arguments, out, digests)
    scene = find_scene(config.scene)
    settings = {"scene_version": scene.full_version}
    if arguments.bank is not None:
        encoders, bank = pretrained_for(
            config.tasks, arguments.bank, scene=scene, weights=arguments.encoders
        )
        settings |= {"encoders": encoders.identity, "bank": bank.identity}
    if arguments.logged is not None:
        settings["logged"] = LoggedEpisodes.load(arguments.logged).identity
    check_settings(out, settings)


def _repeated(
    arguments: Arguments, config: RunConfig
) -> tuple[Representation, DemonstrationBank] | None:
    """Return the encoders and the bank of the run that ``--config`` names; None if it names none.

    Raises:
        ValueError: If the run has other tasks and files of its own, or began with logged episodes
            and none are given.
    """
    if arguments.config is None:
        return None
    of_run, digests = begun_with(arguments)
    if digests.encoders is None:
        return None
    path = arguments.config if arguments.config.is_dir() else arguments.config.parent
    if digests.logged is not None and arguments.logged is None:
        raise ValueError(f"{path} began with logged episodes: name them with --logged")
    if (of_run.scene, of_run.tasks) != (config.scene, config.tasks):
        if not (own_weights(path).exists() or (path / BANK).exists()):
            return None  # those that come with the scene
        raise ValueError(
            f"{path} has the tasks {', '.join(of_run.tasks)}, not {', '.join(config.tasks)}: name "
            "demonstrations of the others with --bank, or encoders with --encoders"
        )
    return load_inputs(path, config.tasks, digests, find_scene(config.scene))


def _continued(arguments: Arguments, config: RunConfig, saved: RunConfig) -> RunConfig:
    """Return the settings with which a run continues: its task starts and evaluation interval.

    Both depend on the length of a run by default, and flags set them.
    """
    from_start = [[start == 0 for start in run.task_starts] for run in (saved, config)]
    if from_start[0] != from_start[1]:  # another experiment, which `Trainer` refuses
        return config
    kept = ("task_starts", "eval_every")
    own = {name: getattr(saved, name) for name in kept if not arguments.gives(name)}
    return replace(config, **own)


def _inputs(
    arguments: Arguments,
    config: RunConfig,
    out: Path,
    device: torch.device,
    digests: Digests | None,
) -> tuple[Representation, DemonstrationBank]:
    """Return encoders and a bank: those of a run that has begun, trained ones, or new ones."""
    scene, bank = find_scene(config.scene), arguments.bank
    if digests is not None and bank is None:
        try:
            return load_inputs(out, config.tasks, digests, scene)
        except ValueError:
            # Killed before its first checkpoint, a run may lack its copies of what is named.
            if not has_checkpoint(out / "checkpoint"):
                if arguments.encoders is not None:
                    return pretrained_for(config.tasks, scene=scene, weights=arguments.encoders)
                if found := _repeated(arguments, config):
                    return found
            raise
    # A bank fits only the encoders that embedded it.
    given = arguments.encoders is not None or bank is not None
    if not (given or arguments.train_encoders) and (found := _repeated(arguments, config)):
        return found
    stage = STAGE_PRESETS.get(arguments.preset or "", {})
    if not arguments.train_encoders and (given or not stage):
        if arguments.resume and not holds_run(out) and (out / _DATASET).exists():
            raise ValueError(
                f"{out} holds the beginning of new encoders: add --train-encoders, or name another "
                "directory"
            )
        return pretrained_for(config.tasks, bank, scene=scene, weights=arguments.encoders)
    if arguments.encoder_settings is not None:
        usual = stage.get("config", RepresentationConfig())
        stage = {**stage, "config": read_encoder_settings(arguments.encoder_settings, usual)}
    encoders, made = make_pretrained(
        own_weights(out),
        out / _DATASET,
        folder=own_weights(out).parent,
        command=command(),
        device=device,
        tasks=config.tasks,
        spread=config.spread,
        scene=scene,
        **stage,
    )
    return encoders, made.for_tasks(config.tasks)


def pretrained_for(
    tasks: Sequence[str],
    bank: Path | None = None,
    *,
    scene: Scene | str = "nico",
    weights: Path | None = None,
) -> tuple[Representation, DemonstrationBank]:
    """Load trained encoders and the demonstrations of some tasks.

    Those that ``bank`` lacks are taken from the bank beside the encoders. By default, the file
    ``weights`` of the encoders is the one of the bank or, without a bank, of the scene.

    Raises:
        ValueError: If a file is missing, damaged or of other encoders, no encoders come with the
            scene, or a task has no demonstrations.
    """
    if bank is None:
        encoders, found = load_pretrained(weights, tasks=tasks, scene=scene)
        return encoders, found.for_tasks(tasks)
    scene = find_scene(scene)
    weights = weights or weights_of_bank(bank, scene)
    encoders = load_representation(weights, scene=scene)
    found = DemonstrationBank.load(bank, encoder_id=encoders.identity)
    lacking = [task for task in tasks if task not in found.tasks]
    if lacking:
        found += load_pretrained(weights, scene=scene)[1].for_tasks(lacking)
    return encoders, found.for_tasks(tasks)


def bank_of(arguments: BankArguments) -> DemonstrationBank:
    """Load the demonstrations that a command line names, embedded by trained encoders."""
    scene = find_scene(arguments.scene or "nico")
    tasks = chosen_tasks(arguments.tasks, scene)
    return pretrained_for(tasks, arguments.bank, scene=scene, weights=arguments.encoders)[1]
