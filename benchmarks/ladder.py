"""Which part limits learning: one learner with less and less given information.

    python benchmarks/ladder.py --rungs a b c d --episodes 2000

All three tasks are presented from the start (the paper's concurrent setting). Rung (a) observes
the ground-truth state and the task label; (b) latents and the label; (c) latents and the
demonstration's embedding phi; (d) is BGPO: latents and the behavior b of GWR-B. A drop from one
rung to the next points to the limiting part: frame encoder, sequence encoder or
self-organization. The effect of a setting of the learner is measured on one rung:

    python benchmarks/ladder.py --rungs a --out runs/ladder-64 ddpg --hidden-sizes 64
    python benchmarks/ladder.py --rungs a --out runs/ladder-td3 td3
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import subcommand

from bgpo_trl.algorithms import ALGORITHMS
from bgpo_trl.algorithms.bgpo import BGPO
from bgpo_trl.analysis.comparison import read_run
from bgpo_trl.analysis.scores import episodes_to_80, late_scores
from bgpo_trl.analysis.statistics import mean
from bgpo_trl.analysis.tables import markdown
from bgpo_trl.configs import PRESETS, BGPOConfig, DDPGConfig, SACConfig, TD3Config
from bgpo_trl.encoders.pretrained import load_pretrained
from bgpo_trl.experiments.arguments import command_line
from bgpo_trl.figures.curves import plot_success_curves
from bgpo_trl.figures.style import save_figure
from bgpo_trl.machine import choose_device, set_threads
from bgpo_trl.training import Trainer

Rung = Literal["a", "b", "c", "d"]

_SINGLE: Any = ALGORITHMS["bgpo-single"].config

RUNGS: dict[str, tuple[str, BGPOConfig]] = {
    "a": ("ground truth + label", replace(_SINGLE, variant="label", state="state")),
    "b": ("latent + label", replace(_SINGLE, variant="label")),
    "c": ("latent + phi", replace(_SINGLE, variant="without-gwr")),
    "d": ("latent + b (BGPO with one policy)", _SINGLE),
}
"""Description and hyperparameters of each rung."""


@dataclass(frozen=True)
class Arguments:
    """Run the rungs one after another and print a table."""

    rungs: tuple[Rung, ...] = ("a", "b", "c", "d")
    """Rungs to run."""
    episodes: int = 2_000
    """Training episodes of each seed."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds, run as one batch."""
    out: Path = Path("runs/ladder")
    """Parent of the rungs' run directories."""
    rl: (
        Annotated[DDPGConfig, subcommand("ddpg")]
        | Annotated[TD3Config, subcommand("td3")]
        | Annotated[SACConfig, subcommand("sac")]
    ) = field(default_factory=DDPGConfig)
    """The RL algorithm."""
    resume: bool = False
    """Continue interrupted rungs and only read finished ones."""
    device: str = "auto"
    """Device of the networks: cpu, cuda, or auto for a GPU if there is one."""
    threads: int = 1
    """Threads of PyTorch; more than one slows these small networks down. Physics always uses all
    cores."""


def main(arguments: Arguments) -> None:
    """Run the ladder."""
    if not arguments.rungs:
        raise ValueError("--rungs is empty: name some of a, b, c, d")
    if len(set(arguments.rungs)) < len(arguments.rungs):
        raise ValueError(f"--rungs: name each once, got {' '.join(arguments.rungs)}")
    set_threads(arguments.threads)
    device = choose_device(arguments.device)
    encoders, bank = load_pretrained()
    base = replace(
        PRESETS["desk"],
        seeds=arguments.seeds,
        episodes=arguments.episodes,
        task_starts=(0, 0, 0),
        eval_every=max(1, min(100, arguments.episodes)),
        eval_episodes=5,
    )
    table = [["rung", *base.tasks, "all", "episodes to 80 %"]]
    for rung in arguments.rungs:
        _, bgpo = RUNGS[rung]
        out = arguments.out / rung
        algorithm = replace(bgpo, rl=arguments.rl)
        with Trainer(
            replace(base, name=f"rung {rung}", algorithm=algorithm),
            out,
            bank=bank,
            encoders=encoders,
            make=BGPO,
            device=device,
            resume=arguments.resume,
        ) as trainer:
            trainer.run()
        save_figure(plot_success_curves(out / "eval.csv"), out / "figures" / "success.png")
        run = read_run(out)
        late, reached = late_scores(run), episodes_to_80(run)
        table += [
            [
                f"({rung}) {RUNGS[rung][0]}",
                *(f"{100 * share:.1f}" for share in late.mean(0)),
                mean(late.mean(1)).percent(),
                "not reached" if math.isinf(reached) else f"{reached:.0f}",
            ]
        ]
    print(markdown(table))


if __name__ == "__main__":
    command_line(main, __doc__, Arguments)
