"""Command line, run and final measurements, which the paper's experiments share."""

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

# Number of the evaluation after training, which no evaluation in training has: other starts.
_LAST = 2**31
_DATASET, _ENCODERS = "demonstrations", "encoders"  # in the directory of a run that makes its own
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
"""The keys of `ALGORITHMS`, as a command line has to be told them."""


@dataclass(frozen=True)
class Arguments:
    """Trains an algorithm and draws its success."""

    algorithm: AlgorithmName = "bgpo"
    """BGPO, without demonstrations (-experts), with one actor and critic for all behaviors besides
    (-single); a baseline, or one that learns from demonstrations too; any of them as published
    (-paper); or a reference: DDPG that is told the task's label (oracle) or nothing."""
    rl: Literal["ddpg", "td3", "sac"] = "ddpg"
    """The RL algorithm of BGPO, its ablations and the references."""
    preset: Literal["smoke", "quick", "desk", "paper"] = "quick"
    """Size of the run: every stage in minutes; learning to look at; five seeds; the paper's."""
    out: Path | None = None
    """The run's directory; runs/EXPERIMENT-ALGORITHM[-RL]-PRESET if not given."""
    seeds: tuple[int, ...] | None = None
    """Other seeds than the preset's."""
    episodes: int | None = None
    """Another length than the preset's; the tasks' starts keep their proportions. With --resume, a
    longer one goes on from where the run ended; the tasks' starts are what they were."""
    eval_every: int | None = None
    """Other training episodes between tests than the preset's."""
    held_out: Literal["validation", "test"] = "validation"
    """The half of the held-out demonstrations to test on: to choose settings by, or to report."""
    resume: bool = False
    """Continue the run in the directory."""
    train_encoders: bool = False
    """Record demonstrations and train the encoders anew instead of using the shipped ones."""
    wandb: Literal["online", "offline"] | None = None
    """Log to Weights & Biases too."""
    device: str = "auto"
    """Where the networks are: cpu, cuda, or auto for a GPU if there is one."""
    threads: int = 1
    """Threads of PyTorch. More than one slows these small networks down; physics takes all cores by
    itself."""


def run_config(arguments: Arguments) -> RunConfig:
    """Returns the preset, for tasks one after the other, with the changes asked for.

    Raises:
        ValueError: If there is no such run.
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
    """Trains to the end, then measures and draws.

    The run's directory then holds, besides what `Trainer` writes, ``final.csv`` (success of the
    trained policies with demonstrations seen in training and with held-out ones, and task
    inference), ``gwr.csv`` (nodes of the first seed's GWR-B), ``figures/`` (among them a video of a
    test episode of each task) and, when all that is there, ``summary.json`` (commit, command,
    success of a random policy, nodes of GWR-B, groups of behaviors). Weights & Biases gets what is
    in ``figures/`` too.

    Args:
        arguments: From the command line.
        name: The experiment's, for the run's directory.
        config: The run.
        make: Makes the algorithm, where ``config.name`` does not say it.

    Returns:
        Results to print, and where the rest is.

    Raises:
        ValueError: If the directory holds another run, or none that could be resumed.
        BlockingIOError: If another process is at work there.
    """
    commit = commit_of_code()  # of the code that runs, whatever is committed meanwhile
    set_threads(arguments.threads)
    device = choose_device(arguments.device)
    rl = "" if arguments.rl == "ddpg" else f"-{arguments.rl}"
    out = arguments.out or Path("runs") / f"{name}-{config.name}{rl}-{arguments.preset}"
    makes_encoders = arguments.train_encoders or arguments.preset in STAGE_PRESETS
    if arguments.resume:
        begun = makes_encoders and any((out / made).exists() for made in (_DATASET, _ENCODERS))
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
            found = draw(trainer, bank, out, summary["random_success"])
            for path in sorted((out / "figures").iterdir()):
                trainer.logger.log_media(f"figures/{path.stem}", path)
            # Last: it says that the rest is there.
            (out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    found.append(f"curve and figures: {out}; in numbers: python benchmarks/summary.py {out}")
    return "\n".join(found)


def draw(
    trainer: Trainer, bank: DemonstrationBank, out: Path, random_success: Mapping[str, float]
) -> list[str]:
    """Draws the run, and describes its GWR-B.

    Args:
        trainer: At the end of its run.
        bank: Demonstrations of both kinds.
        out: Where ``figures/`` and ``gwr.csv`` go.
        random_success: Of a random policy, by task.

    Returns:
        Lines on GWR-B, its task inference and its groups.
    """
    config, found = trainer.config, list[str]()
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
        found.append(f"GWR-B nodes: {gwr.num_nodes.tolist()}")
        found.append(f"task inference on held-out demonstrations: {accuracy.mean():.1%}")
    if trainer.algorithm.groups is not None:
        draw_groups(out, presented, out / "figures" / "groups.png")
        found.append(f"groups of behaviors: {trainer.algorithm.groups.num_groups.tolist()}")
    return found


def measure(
    trainer: Trainer, bank: DemonstrationBank, out: Path, episodes: int = 20
) -> dict[str, Any]:
    """Tests the trained policies with seen and with held-out demonstrations.

    Args:
        trainer: At the end of its run.
        bank: Demonstrations of both kinds.
        out: Where ``final.csv`` goes.
        episodes: Test episodes of each seed, task and kind.

    Returns:
        What ``summary.json`` says of the run.
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
    """Returns the frames of a test episode of each task by the first seed's trained policy.

    Args:
        trainer: At the end of its run.
        bank: Demonstrations; held-out ones are shown.

    Returns:
        Frames uint8 ``[N, 32, 64, 3]``, by task and outcome.

    Raises:
        ValueError: If the run is one from ground truth, without frames.
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
    """Returns the commit of this code, with ``-dirty`` where it was changed; "" where unknown."""
    root = Path(__file__).parents[2]
    if not (root / ".git").exists():  # installed, perhaps within a repository of something else
        return ""
    command = ["git", "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
    try:
        told = subprocess.run(command, cwd=root, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return ""
    return told.stdout.strip()


def command_line(
    main: Callable[[Any], None],
    description: str | None,
    arguments: type = Arguments,
    options: Sequence[str] | None = None,
) -> None:
    """Runs ``main`` with the arguments of the command line; an expected error becomes one line.

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
