"""Five tasks of Meta-World one after the other, from pixels: from nothing to figures.

Records demonstrations and play, trains encoders on them, and learns. The same command resumes
whatever was interrupted. Run it in the folder of the repository.
"""

from __future__ import annotations

import sys
from pathlib import Path

import tyro

from bgpo_trl.configs import RepresentationConfig, VAEConfig
from bgpo_trl.encoders.pretrained import bank_path
from bgpo_trl.encoders.train import make_pretrained
from bgpo_trl.experiments.arguments import Arguments
from bgpo_trl.experiments.command_line import import_plugin
from bgpo_trl.experiments.run import run_experiment
from bgpo_trl.experiments.settings import run_config
from bgpo_trl.machine import set_threads

ENCODERS = RepresentationConfig(
    vae=VAEConfig(steps=2_000, bfloat16=True),
)


def main(
    folder: Path = Path("runs/metaworld"),
    seeds: tuple[int, ...] = (0, 1, 2),
    episodes: int = 2_500,
) -> None:
    """Learn five tasks of Meta-World, one after the other.

    Args:
        folder: Folder for demonstrations, encoders and the run.
        seeds: Seeds of the run.
        episodes: Training episodes of each seed.
    """
    import_plugin("examples.meta_world")
    set_threads(1)
    weights = folder / "encoders.safetensors"
    if not bank_path(weights).exists():
        make_pretrained(
            weights,
            folder / "demonstrations",
            folder=folder / "encoders",
            config=ENCODERS,
            per_task=350,
            held_out_per_task=50,
            scene="metaworld",
        )
    arguments = Arguments(
        scene="metaworld",
        module="examples.meta_world",
        encoders=weights,
        out=folder / "run",
        episodes=episodes,
        resume=True,
    )
    tests = {"eval_every": episodes // 20, "eval_episodes": 10}
    config = run_config(arguments, changes={"seeds": seeds, **tests})
    print(run_experiment(arguments, "metaworld", config))


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except (ValueError, OSError, RuntimeError) as error:
        sys.exit(f"error: {error}")
