"""The paper's third experiment: BGPO without GWR-B, without the intrinsic reward, without both.

Besides: what experts, even replay and demonstrations add to it.

    python benchmarks/ablation.py --variant r_int --preset quick

The paper's variants (Fig. 9) differ by transforms alone, see `bgpo_trl.algorithms.environments`.
All tasks are presented from the start.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from bgpo_trl.algorithms import ABLATIONS
from bgpo_trl.experiments.run import Arguments as Common
from bgpo_trl.experiments.run import command_line, run_config, run_experiment


@dataclass(frozen=True)
class Arguments(Common):
    """Trains a variant of BGPO and draws its success."""

    variant: Literal[
        "gwr+r_int", "gwr", "r_int", "none", "even-replay", "experts", "demonstrations", "all"
    ] = "gwr+r_int"
    """GWR-B and the intrinsic reward as published; one of them; or none. Or both, and besides:
    replay drawn evenly over groups of behaviors; experts for the groups too; demonstrations as
    experience; or all of it."""
    continual: bool = False
    """Tasks one after the other instead of all from the start."""


def main(arguments: Arguments) -> None:
    """Runs a variant."""
    if arguments.algorithm != "bgpo":
        raise ValueError("--algorithm: the variants are BGPO's")
    config = run_config(arguments)
    algorithm = replace(ABLATIONS[arguments.variant].config, rl=config.algorithm.rl)
    config = replace(config, name=arguments.variant, algorithm=algorithm)
    if not arguments.continual:
        config = replace(config, task_starts=(0, 0, 0))
    name = "ablation-continual" if arguments.continual else "ablation"
    print(run_experiment(arguments, name, config))


if __name__ == "__main__":
    command_line(main, __doc__, Arguments)
