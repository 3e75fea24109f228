"""Which part limits learning: one learner with less and less given information.

python benchmarks/studies/privileged_information.py
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from bgpo_trl.algorithms import ALGORITHMS
from bgpo_trl.analysis.scores import late_scores
from bgpo_trl.analysis.statistics import mean
from bgpo_trl.analysis.tables import Table, markdown
from bgpo_trl.configs import PRESETS, RLConfig
from bgpo_trl.encoders.pretrained import load_pretrained
from bgpo_trl.experiments.command_line import command_line
from bgpo_trl.figures.style import save_figure
from bgpo_trl.figures.success import plot_success_curves
from bgpo_trl.machine import choose_device, set_threads
from bgpo_trl.runs.results import read_run
from bgpo_trl.training import Trainer

INPUTS: dict[str, tuple[str, dict[str, Any]]] = {
    "state+label": ("oracle", {"state": "state"}),
    "latent+label": ("oracle", {}),
    "latent+phi": ("without-gwr", {}),
    "latent+behavior": ("bgpo-single", {}),
}
"""Algorithm, and changes of its hyperparameters, by what the policy observes; from the ground truth
and the task's label to what BGPO observes."""


@dataclass(frozen=True)
class InformationArguments:
    """Runs of one learner with different inputs."""

    inputs: tuple[str, ...] = tuple(INPUTS)
    """Inputs of the policies: state+label, latent+label, latent+phi, latent+behavior; a run
    each."""
    episodes: int = 2_000
    """Training episodes of each seed."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds, run as one batch."""
    out: Path = Path("runs/privileged-information")
    """Parent of the run directories."""
    rl: RLConfig = field(default_factory=RLConfig)
    """The learner."""
    resume: bool = False
    """Continue interrupted runs and only read finished ones."""
    device: str = "auto"
    """Device of the networks: cpu, cuda, or auto for a GPU if there is one."""
    threads: int = 1
    """Threads of PyTorch; more than one slows these small networks down. Physics always uses all
    cores."""


def privileged_information(arguments: InformationArguments) -> str:
    """Train one learner with less and less given information, to find which part limits it.

    All three tasks are presented from the start. The policy observes the ground truth and the
    task's label; latents and the label; latents and the demonstration's embedding phi; or, as in
    BGPO with one policy, latents and the behavior of GWR-B. A drop from one to the next points to
    the limiting part: frame encoder, sequence encoder or self-organization. Prints a table.
    Settings of the learner: --inputs state+label --rl.hidden-sizes 64

    Raises:
        ValueError: If an input is unknown or repeated, or a directory holds another run.
    """
    names = arguments.inputs
    if not names or len(set(names)) < len(names) or not {*names} <= {*INPUTS}:
        raise ValueError(f"--inputs: name some of {', '.join(INPUTS)}, each once")
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
    table: Table = [["policy observes", *base.tasks, "all"]]
    for name in names:
        algorithm, changes = INPUTS[name]
        settings: Any = {**changes, "rl": arguments.rl}
        config = replace(ALGORITHMS[algorithm].config, **settings)
        out = arguments.out / name
        with Trainer(
            replace(base, name=algorithm, algorithm=config),
            out,
            bank=bank,
            encoders=encoders,
            device=device,
            resume=arguments.resume,
        ) as trainer:
            trainer.run()
        run = read_run(out)
        save_figure(plot_success_curves({name: run}), out / "figures" / "success.png")
        late = late_scores(run)
        shares = [f"{100 * share:.1f}" for share in late.mean(0)]
        table.append([name, *shares, mean(late.mean(1)).percent()])
    return markdown(table)


if __name__ == "__main__":
    command_line(privileged_information)
