"""Shared parts of the paper's experiments: command line, training run, final tests and figures."""

from __future__ import annotations

import csv
import json
import shlex
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from bgpo_trl.algorithms import ALGORITHMS, Algorithm
from bgpo_trl.algorithms.rl import RL
from bgpo_trl.analysis.task_inference import group_purity, task_inference_accuracy
from bgpo_trl.configs import PRESETS, STAGE_PRESETS, RunConfig
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.encoders.pretrained import load_pretrained, make_pretrained
from bgpo_trl.evaluation import Evaluator, evaluate_random_policy
from bgpo_trl.experiments.resuming import as_begun, check_resumable, is_finished
from bgpo_trl.figures.curves import plot_frame_strips, plot_success_curves, save_figure
from bgpo_trl.figures.of_run import draw_groups, draw_growth, draw_nodes
from bgpo_trl.figures.video import save_gif
from bgpo_trl.files.locking import DirectoryLock
from bgpo_trl.files.progress import progress_bar
from bgpo_trl.machine import choose_device, set_threads
from bgpo_trl.training import Trainer
from bgpo_trl.transforms import TaskSchedule

# Number of the evaluation after training; it seeds start states that training never tested.
_LAST = 2**31
_DATASET, _ENCODERS = "demonstrations", "encoders"  # folders of a run that trains its encoders
FINAL_COLUMNS = ("seed", "demonstrations", "task", "episodes", "success", "task_inference")


AlgorithmName = Literal[
    "bgpo",
    "bgpo-experts",
    "bgpo-single",
    "bgpo-paper",
    "maml",
    "maml-demonstrations",
    "maml-paper",
    "dist-nll",
    "dist-nll-demonstrations",
    "dist-nll-paper",
    "oracle",
    "ddpg",
]
"""The keys of `ALGORITHMS`, spelled out for the command line's choices."""


@dataclass(frozen=True)
class Arguments:
    """Train an algorithm and plot its success."""

    algorithm: AlgorithmName = "bgpo"
    """BGPO, also without replay of demonstrations (-experts) and without experts either (-single);
    a baseline, with or without -demonstrations; any of them as published (-paper); or a reference:
    DDPG with the task label as context (oracle) or without any (ddpg)."""
    rl: Literal["ddpg", "td3", "sac"] = "ddpg"
    """The RL algorithm of BGPO, its ablations and the references."""
    preset: Literal["smoke", "quick", "desk", "paper"] = "quick"
    """Size of the run: smoke (every stage in minutes), quick (visible learning), desk (five seeds)
    or paper (the paper's size)."""
    out: Path | None = None
    """Run directory; runs/EXPERIMENT-ALGORITHM[-RL]-PRESET by default."""
    seeds: tuple[int, ...] | None = None
    """Seeds; the preset's by default."""
    episodes: int | None = None
    """Training episodes; the preset's by default. The task starts are scaled in proportion. With
    --resume, a larger number extends the run, whose task starts are kept."""
    eval_every: int | None = None
    """Training episodes between evaluations; the preset's by default."""
    held_out: Literal["validation", "test"] = "validation"
    """Half of the held-out demonstrations to test on: validation to choose settings, test to report
    results."""
    resume: bool = False
    """Continue the run in the directory."""
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

    Raises:
        ValueError: If the settings are invalid.
    """
    algorithm = ALGORITHMS[arguments.algorithm].config
    if arguments.rl != algorithm.rl.name:
        algorithm = replace(algorithm, rl=RL[arguments.rl].config)
    config = replace(
        PRESETS[arguments.preset],
        name=arguments.algorithm,
        algorithm=algorithm,
        held_out=arguments.held_out,
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
    return config


def run_experiment(
    arguments: Arguments,
    name: str,
    config: RunConfig,
    make: Callable[..., Algorithm] | None = None,
) -> str:
    """Train to the end, run the final tests and draw the figures.

    In addition to the files of `Trainer`, the run directory gets ``final.csv`` (success of the
    trained policies with demonstrations seen in training and with held-out ones, and task
    inference), ``gwr.csv`` (nodes of the first seed's GWR-B), ``figures/`` (including a video of a
    test episode of each task; also logged to Weights & Biases) and finally ``summary.json``
    (commit, command, success of a random policy, nodes of GWR-B, groups of behaviors).

    Args:
        arguments: Arguments of the command line.
        name: Name of the experiment, for the run directory.
        config: Settings of the run.
        make: Factory of the algorithm; by default the one registered as ``config.name``.

    Returns:
        Results to print, with the path of the run directory.

    Raises:
        ValueError: If the directory holds another run, or no run to resume.
        BlockingIOError: If another process is using the directory.
    """
    commit = commit_of_code()  # read first, since commits may follow during training
    set_threads(arguments.threads)
    device = choose_device(arguments.device)
    rl = "" if arguments.rl == "ddpg" else f"-{arguments.rl}"
    out = arguments.out or Path("runs") / f"{name}-{config.name}{rl}-{arguments.preset}"
    makes_encoders = arguments.train_encoders or arguments.preset in STAGE_PRESETS
    if arguments.resume:
        begun = makes_encoders and any((out / folder).exists() for folder in (_DATASET, _ENCODERS))
        if not begun:
            check_resumable([out])
        config = as_begun(config, out, keep_eval_every=arguments.eval_every is not None)
        if is_finished(out, config):
            return f"{out} is finished, all {config.episodes} episodes: --episodes makes it longer"
    elif (out / "config.json").exists():
        raise ValueError(f"{out} holds a run: --resume continues it, --out names another directory")
    with DirectoryLock(out):
        if makes_encoders:
            stage = STAGE_PRESETS.get(arguments.preset)
            encoders, bank = make_pretrained(
                out / _ENCODERS / "nico.safetensors",
                out / _DATASET,
                folder=out / _ENCODERS,
                command=shlex.join(["python", *sys.argv]),
                device=device,
                **({} if stage is None else vars(stage)),
            )
        else:
            encoders, bank = load_pretrained()

        bank = bank.for_tasks(config.tasks)
        with Trainer(
            config,
            out,
            bank=bank,
            encoders=encoders,
            make=make,
            device=device,
            resume=arguments.resume,
            wandb=arguments.wandb,
        ) as trainer:
            trainer.run()
            summary = {"commit": commit, **measure(trainer, bank, out)}
            lines = draw(trainer, bank, out, summary["random_success"])
            for path in sorted((out / "figures").iterdir()):
                trainer.logger.log_media(f"figures/{path.stem}", path)
            # Written last, as the mark of a complete run.
            (out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    lines.append(f"curve and figures: {out}; in numbers: python benchmarks/summary.py {out}")
    return "\n".join(lines)


def draw(
    trainer: Trainer, bank: DemonstrationBank, out: Path, random_success: Mapping[str, float]
) -> list[str]:
    """Draw the figures of the run, and describe its GWR-B.

    Args:
        trainer: The trainer after training.
        bank: Training and held-out demonstrations.
        out: Folder for ``figures/`` and ``gwr.csv``.
        random_success: Success of a random policy, by task.

    Returns:
        Lines about GWR-B, its task inference and its groups.
    """
    config, lines = trainer.config, list[str]()
    presented = dict(zip(config.tasks, config.task_starts, strict=True))
    figure = plot_success_curves(
        out / "eval.csv", presented=presented, random_success=random_success
    )
    save_figure(figure, out / "figures" / "success.png")
    episodes = record_episodes(trainer, bank)
    save_figure(plot_frame_strips(episodes), out / "figures" / "episodes.png")
    for title, frames in episodes.items():
        save_gif(frames, out / "figures" / f"{title.split()[0]}.gif")
    gwr = trainer.algorithm.gwr
    if gwr is not None:
        draw_nodes(out, trainer.algorithm, bank, config.tasks)
        accuracy = task_inference_accuracy(
            gwr, bank.seen(), bank.held_out(config.held_out), len(config.tasks)
        )
        draw_growth(out, config, bank)
        lines.append(f"GWR-B nodes: {gwr.num_nodes.tolist()}")
        lines.append(f"task inference on held-out demonstrations: {accuracy.mean():.1%}")
    if trainer.algorithm.groups is not None:
        draw_groups(out, presented, out / "figures" / "groups.png")
        lines.append(f"groups of behaviors: {trainer.algorithm.groups.num_groups.tolist()}")
    return lines


def measure(
    trainer: Trainer, bank: DemonstrationBank, out: Path, episodes: int = 20
) -> dict[str, Any]:
    """Test the trained policies with seen and with held-out demonstrations.

    Args:
        trainer: The trainer after training.
        bank: Training and held-out demonstrations.
        out: Folder for ``final.csv``.
        episodes: Test episodes per seed, task and kind of demonstrations.

    Returns:
        Entries of ``summary.json``.
    """
    algorithm, config, seen = trainer.algorithm, trainer.config, bank.seen()
    gwr = algorithm.gwr
    rows, schedule = [], TaskSchedule(config.task_starts)
    n_steps = config.algorithm.max_steps + 1
    bar = progress_bar("final tests", shown=trainer.progress, total=2 * n_steps, unit="step")
    for half, (kind, tested) in enumerate(
        (("seen", seen), ("held-out", bank.held_out(config.held_out))), 1
    ):
        evaluator = Evaluator(
            config.algorithm,
            seeds=config.seeds,
            schedule=schedule,
            episodes=episodes,
            bank=tested,
            encoders=trainer.encoders,
        )
        snapshots = [
            evaluator.snapshot(algorithm, index, _LAST, episode=config.episodes)
            for index in range(len(config.seeds))
        ]
        success = evaluator.run(snapshots, algorithm.device, watch=bar.update).success
        bar.set_postfix_str(f"success {success.float().mean():.2f}, {kind}", refresh=False)
        bar.update(half * n_steps - bar.n)  # episodes may all end earlier
        for task, name in enumerate(config.tasks):
            of_task = tested.of_task(task)
            inferred: list[float | str] = [""] * len(config.seeds)
            if gwr is not None:
                accuracy = task_inference_accuracy(gwr, seen, of_task, len(config.tasks))
                inferred = [round(share, 4) for share in accuracy.tolist()]
            for index, seed in enumerate(config.seeds):
                share = round(success[index, task].float().mean().item(), 4)
                rows.append((seed, kind, name, episodes, share, inferred[index]))
    bar.close()
    with (out / "final.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(FINAL_COLUMNS)
        writer.writerows(rows)
    random_success = evaluate_random_policy(tasks=config.tasks, episodes=100)
    summary = {
        "command": shlex.join(["python", *sys.argv]),
        "episodes": config.episodes,
        "random_success": dict(zip(config.tasks, random_success.tolist(), strict=True)),
        "nodes": None if gwr is None else gwr.num_nodes.tolist(),
        "groups": None,
    }
    if algorithm.groups is not None:
        purity = group_purity(algorithm.groups, bank.held_out(config.held_out), len(config.tasks))
        summary["groups"] = algorithm.groups.num_groups.tolist()
        summary["group_purity"] = purity.tolist()
    return summary


def record_episodes(trainer: Trainer, bank: DemonstrationBank) -> dict[str, np.ndarray]:
    """Return the frames of a test episode of each task with the first seed's trained policy.

    Args:
        trainer: The trainer after training.
        bank: Training and held-out demonstrations; held-out ones are shown.

    Returns:
        Frames uint8 ``[N, 32, 64, 3]``, by task and outcome.

    Raises:
        ValueError: If the run observes ground truth instead of frames.
    """
    config, frames = trainer.config, []
    evaluator = Evaluator(
        config.algorithm,
        seeds=config.seeds,
        schedule=TaskSchedule(config.task_starts),
        episodes=1,
        bank=bank.held_out(config.held_out),
        encoders=trainer.encoders,
    )
    algorithm, seeds = trainer.algorithm, range(len(config.seeds))
    snapshots = [evaluator.snapshot(algorithm, i, _LAST, episode=config.episodes) for i in seeds]
    result = evaluator.run(
        snapshots,
        algorithm.device,
        watch=lambda: frames.append(evaluator.simulation.frames()[0, :, 0]),
    )
    return {
        f"{name} ({'success' if result.success[0, task, 0] else 'no success'})": np.stack(
            [frame[task] for frame in frames[: int(result.steps[0, task, 0]) + 1]]
        )
        for task, name in enumerate(config.tasks)
    }


def commit_of_code() -> str:
    """Return the commit of this code, with ``-dirty`` if it was modified; ``""`` if unknown."""
    root = Path(__file__).parents[2]
    if not (root / ".git").exists():  # An installed package may lie in another repository.
        return ""
    command = ["git", "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
    try:
        result = subprocess.run(command, cwd=root, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return ""
    return result.stdout.strip()


def command_line(
    main: Callable[[Any], None],
    description: str | None,
    arguments: type = Arguments,
    options: Sequence[str] | None = None,
) -> None:
    """Run ``main`` with the arguments of the command line; an expected error becomes one line.

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
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit("interrupted: the same command with --resume continues")
