"""The paper's second experiment: NICO's three tasks, presented one after the other (Fig. 8).

    python benchmarks/continual.py --preset quick

writes a run directory with ``config.json``, ``train.csv``, ``eval.csv``, ``checkpoint/`` and the
figures ``success.png`` (success on each task against training episodes) and ``gwr.png`` (the nodes
of GWR-B in behavior space, coloured by task, Fig. 7).
"""

from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import torch
import tyro

from bgpo_trl.configs import PRESETS, STAGE_PRESETS, RunConfig
from bgpo_trl.evaluation import evaluate_random_policy
from bgpo_trl.machine import choose_device
from bgpo_trl.metrics import majority_task, match_counts, task_inference_accuracy
from bgpo_trl.plotting import plot_gwr_pca, plot_success_curves, save_figure
from bgpo_trl.pretrained import load_pretrained, make_pretrained
from bgpo_trl.training import Trainer
from suites import nico


@dataclass(frozen=True)
class Arguments:
    """Trains BGPO on tasks that are presented one after the other, and draws its success."""

    preset: Literal["smoke", "quick", "desk", "paper"] = "quick"
    """Size of the run: every stage in minutes; learning to look at; five seeds; the paper's."""
    out: Path | None = None
    """The run's directory; runs/continual-PRESET if not given."""
    seeds: tuple[int, ...] | None = None
    """Other seeds than the preset's."""
    episodes: int | None = None
    """Another length than the preset's; the tasks' starts keep their proportions."""
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
    """Returns the preset with the changes asked for.

    Raises:
        ValueError: If there is no such run.
    """
    config = PRESETS[arguments.preset]
    if arguments.seeds is not None:
        config = replace(config, seeds=arguments.seeds)
    if arguments.episodes is not None:
        share = arguments.episodes / config.episodes
        starts = tuple(round(start * share) for start in config.task_starts)
        config = replace(
            config,
            episodes=arguments.episodes,
            task_starts=starts,
            eval_every=max(1, min(config.eval_every, arguments.episodes)),
        )
    return config


def main(arguments: Arguments) -> None:
    """Runs the experiment."""
    torch.set_num_threads(arguments.threads)
    device = choose_device(arguments.device)
    config = run_config(arguments)
    out = arguments.out or Path("runs") / f"continual-{arguments.preset}"
    if (out / "config.json").exists() and not arguments.resume:
        raise ValueError(f"{out} holds a run: --resume continues it, --out names another directory")
    if arguments.train_encoders or arguments.preset in STAGE_PRESETS:
        stage = STAGE_PRESETS.get(arguments.preset)
        encoders, bank = make_pretrained(
            out / "encoders" / "nico.safetensors",
            out / "demonstrations",
            folder=out / "encoders",
            command=shlex.join(["python", *sys.argv]),
            device=device,
            **({} if stage is None else vars(stage)),
        )
    else:
        encoders, bank = load_pretrained()

    trainer = Trainer(
        config,
        out,
        bank=bank,
        encoders=encoders,
        device=device,
        resume=arguments.resume,
        wandb=arguments.wandb,
    )
    trainer.run()

    random_success = evaluate_random_policy(n_tasks=3, episodes=100)
    figure = plot_success_curves(
        out / "eval.csv",
        presented=dict(zip(nico.ALL_TASKS, config.task_starts, strict=True)),
        random_success=dict(zip(nico.ALL_TASKS, random_success.tolist(), strict=True)),
    )
    save_figure(figure, out / "figures" / "success.png")
    gwr = trainer.algorithm.gwr
    assert gwr is not None
    tasks = majority_task(match_counts(gwr, bank.seen(), 3)[0])
    graph = gwr.graph(0)
    figure = plot_gwr_pca(graph.weights, tasks[: len(graph.weights)], nico.ALL_TASKS)
    save_figure(figure, out / "figures" / "gwr.png")
    accuracy = task_inference_accuracy(gwr, bank.seen(), bank.held_out(), 3)
    print(f"GWR-B nodes: {gwr.num_nodes.tolist()}")
    print(f"task inference on held-out demonstrations: {accuracy.mean():.1%}")
    print(f"curve and figures: {out}")


if __name__ == "__main__":
    try:
        main(tyro.cli(Annotated[Arguments, tyro.conf.OmitArgPrefixes], description=__doc__))
    except (ValueError, OSError, RuntimeError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit("interrupted: the same command with --resume continues")
