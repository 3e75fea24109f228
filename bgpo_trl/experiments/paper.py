"""The paper's three experiments: tasks in sequence, all tasks from the start, the ablation.

Each trains to the end and returns its results as text.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from bgpo_trl.algorithms import ABLATIONS
from bgpo_trl.experiments.arguments import Arguments, at_once, run_config
from bgpo_trl.experiments.run import run_experiment

__all__ = ["AblationArguments", "ablation", "concurrent", "continual"]


def continual(arguments: Arguments) -> str:
    """Train an algorithm on tasks presented one after the other (Fig. 8)."""
    return run_experiment(arguments, "continual", run_config(arguments))


def concurrent(arguments: Arguments) -> str:
    """Train an algorithm on tasks that are all presented from the start (Fig. 6)."""
    config = at_once(run_config(arguments))
    return run_experiment(arguments, "concurrent", config)


@dataclass(frozen=True)
class AblationArguments(Arguments):
    """Trains a variant of BGPO and draws its success."""

    variant: Literal[
        "gwr+r_int", "gwr", "r_int", "none", "even-replay", "experts", "demonstrations", "all"
    ] = "gwr+r_int"
    """gwr+r_int: the paper's algorithm, with our stabilizers; gwr, r_int: with GWR-B or the
    intrinsic reward only; none: with neither. even-replay, demonstrations: gwr+r_int with that
    addition; experts: with even replay and experts; all: with all three."""
    continual: bool = False
    """Tasks one after the other instead of all from the start."""


def ablation(arguments: AblationArguments) -> str:
    """Train a variant of BGPO (Fig. 9).

    Raises:
        ValueError: If ``--algorithm`` is given.
    """
    if arguments.algorithm != "bgpo":
        raise ValueError("--algorithm: the variants are BGPO's")
    config = run_config(arguments)
    algorithm = replace(ABLATIONS[arguments.variant].config, rl=config.algorithm.rl)
    config = replace(config, name=arguments.variant, algorithm=algorithm)
    if not arguments.continual:
        config = at_once(config)
    name = "ablation-continual" if arguments.continual else "ablation"
    return run_experiment(arguments, name, config)
