"""Continual World's ten tasks, one after the other, from pixels: from nothing to a table.

Records demonstrations, trains encoders on them, learns with each algorithm, and writes the report.
The same command resumes whatever was interrupted. Run it in the folder of the repository:

    python benchmarks/continual_world.py
    python benchmarks/continual_world.py --small --folder runs/cw10-small

docs/benchmark.md says what is different from Continual World.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import tyro

from bgpo_trl.algorithms import entry
from bgpo_trl.configs import (
    InverseModelConfig,
    RepresentationConfig,
    SequenceAutoencoderConfig,
    VAEConfig,
)
from bgpo_trl.data.recording import record_demonstrations
from bgpo_trl.encoders.train import make_bank, train_encoders
from bgpo_trl.experiments.arguments import Arguments, ReportArguments
from bgpo_trl.experiments.command_line import import_plugin
from bgpo_trl.experiments.report import report
from bgpo_trl.experiments.run import run_experiment
from bgpo_trl.experiments.settings import run_config
from bgpo_trl.files.writing import write_json
from bgpo_trl.machine import set_threads
from bgpo_trl.scenes import find_scene

MODULE, SCENE = "examples.continual_world", "cw10"
HELD_OUT = 10  # further demonstrations of each task, which test episodes show
# Demonstrations come with their actions: no inverse model has to infer them.
WITHOUT_INVERSE = InverseModelConfig(steps=0)
ENCODERS = RepresentationConfig(vae=VAEConfig(bfloat16=True), inverse=WITHOUT_INVERSE)
SMALL_ENCODERS = RepresentationConfig(
    vae=VAEConfig(steps=400, bfloat16=True),
    lae=SequenceAutoencoderConfig(steps=400, batch_size=64),
    inverse=WITHOUT_INVERSE,
)


def make_encoders(
    folder: Path, demonstrations: int, encoder_tasks: int, config: RepresentationConfig
) -> tuple[Path, Path]:
    """Record demonstrations, train encoders on them and embed them, unless that is done.

    There is no play: encoders see the demonstrations of the first ``encoder_tasks`` alone.

    Returns:
        The files of the encoders and of the bank of all tasks.

    Raises:
        ValueError: If the folder has encoders of other settings.
    """
    weights, bank = folder / "encoders.safetensors", folder / "bank.safetensors"
    record, steps = folder / "encoders.json", config.vae.steps
    made = {"demonstrations": demonstrations, "encoder_tasks": encoder_tasks, "vae_steps": steps}
    if bank.exists():
        # Those of the archive come without a record.
        if record.exists() and (found := json.loads(record.read_text())) != made:
            raise ValueError(
                f"{folder} has encoders of {found}, asked for are {made}: choose another --folder"
            )
        return weights, bank
    tasks = find_scene(SCENE).default_tasks
    dataset = record_demonstrations(
        folder / "demonstrations",
        scene=SCENE,
        per_task=demonstrations + HELD_OUT,
        held_out_per_task=HELD_OUT,
    )
    seen, known = dataset[dataset["task"] < encoder_tasks], tasks[:encoder_tasks]
    encoders, _ = train_encoders(
        seen, None, weights, folder / "encoders", config, tasks=known, scene=SCENE
    )
    write_json(record, made)
    make_bank(encoders, dataset, tasks=tasks).save(bank)
    return weights, bank


def main(
    folder: Path = Path("runs/cw10"),
    algorithms: tuple[str, ...] = (
        "bgpo",
        "clone",
        "dist-nll-demonstrations",
        "oracle-demonstrations",
        "fine-tuning-demonstrations",
        "ewc-demonstrations",
    ),
    seeds: tuple[int, ...] = (0, 1, 2),
    demonstrations: int = 30,
    episodes: int = 300,
    encoder_tasks: int = 10,
    joints: bool = False,
    successes: float = 0.5,
    small: bool = False,
) -> None:
    """Learn Continual World's ten tasks, one after the other.

    Args:
        folder: Folder for demonstrations, encoders, runs and the report.
        algorithms: Algorithms, as in `bgpo continual`.
        seeds: Seeds of each run.
        demonstrations: Demonstrations of each task in training.
        episodes: Training episodes of each task.
        encoder_tasks: Number of tasks, from the first on, whose demonstrations encoders see.
        joints: Whether policies and critics read the hand's position and the gripper's opening
            beside frames. Such runs have a bank of their own: give them a folder of their own.
        successes: Share of own successes in what `bgpo` and other learners from demonstrations
            imitate (`success_share`); the clone imitates demonstrations alone.
        small: One seed of bgpo and clone, 20 episodes of each task, and encoders trained a tenth
            as long. It shows that all parts work, not what can be learned.
    """
    import_plugin(MODULE)
    set_threads(1)
    if small:
        algorithms, seeds, episodes = ("bgpo", "clone"), (0,), 20
    tasks = find_scene(SCENE).default_tasks
    config = SMALL_ENCODERS if small else ENCODERS
    weights, bank = make_encoders(folder, demonstrations, encoder_tasks, config)
    for algorithm in algorithms:
        arguments = Arguments(
            scene=SCENE,
            module=MODULE,
            encoders=weights,
            bank=bank,
            algorithm=algorithm,
            episodes=episodes * len(tasks),
            out=folder / f"run-{algorithm}",
            resume=True,
            settings=_settings(algorithm, joints, successes),
        )
        changes = {
            "seeds": seeds,
            "schedule": "sequential",
            "task_starts": tuple(range(0, episodes * len(tasks), episodes)),
            "eval_every": max(1, episodes // 2),
            "eval_episodes": 2 if small else 10,
        }
        print(run_experiment(arguments, "cw10", run_config(arguments, changes=changes)))
    print(report(ReportArguments(runs=(folder,))))


def _settings(algorithm: str, joints: bool, successes: float) -> tuple[str, ...]:
    flags = ["--algorithm.joints"] if joints else []
    if entry(algorithm).config.rl.imitates and algorithm != "clone":
        flags.append(f"--algorithm.rl.success-share={successes}")
    return tuple(flags)


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except (ValueError, OSError, RuntimeError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit("interrupted: the same command continues")
