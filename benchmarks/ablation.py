"""The paper's third experiment: BGPO without GWR-B, without the intrinsic reward, without both.

Further variants add even replay, experts and demonstrations.

    python benchmarks/ablation.py --variant r_int --preset quick

Variants differ only in the transforms and settings below (Fig. 9). All tasks are presented from
the start.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

from torchrl.envs import RenameTransform

from bgpo_trl.algorithms import ALGORITHMS
from bgpo_trl.algorithms.bgpo import BGPO, Composition, Parts
from bgpo_trl.configs import BGPOConfig
from bgpo_trl.experiments.run import Arguments as Common
from bgpo_trl.experiments.run import command_line, run_config, run_experiment
from bgpo_trl.transforms import BehaviorLookup


def demonstration_itself() -> RenameTransform:
    """Return the transform that replaces GWR-B: the demonstration's embedding is the behavior."""
    return RenameTransform(["demo_embedding"], ["behavior"], create_copy=True)


def published(parts: Parts) -> Composition:
    """Return BGPO's own composition, with GWR-B and the intrinsic reward."""
    return Composition(
        infer=[BehaviorLookup(parts.gwr, learn=True)],
        reward=[parts.behavior_matching_reward()],
    )


_SINGLE: Any = ALGORITHMS["bgpo-single"].config

VARIANTS: dict[str, tuple[Callable[[Parts], Composition], BGPOConfig]] = {
    "gwr+r_int": (published, _SINGLE),
    "gwr": (
        lambda parts: Composition(infer=[BehaviorLookup(parts.gwr, learn=True)]),
        _SINGLE,
    ),
    "r_int": (
        lambda parts: Composition(
            infer=[demonstration_itself()],
            reward=[parts.behavior_matching_reward()],
        ),
        _SINGLE,
    ),
    "none": (lambda parts: Composition(infer=[demonstration_itself()]), _SINGLE),
    "even-replay": (published, replace(_SINGLE, even_replay=True)),
    "experts": (published, replace(_SINGLE, even_replay=True, experts=True)),
    "demonstrations": (published, replace(_SINGLE, demonstration_share=0.25)),
    "all": (published, BGPOConfig()),
}
"""Transforms and settings of each variant. The first four are the paper's; the others add to it:
even replay, experts on top, demonstrations, and all three."""


def make_of(name: str) -> Callable[..., BGPO] | None:
    """Return the factory of a variant; ``None`` for any other name."""
    return partial(BGPO, compose=VARIANTS[name][0]) if name in VARIANTS else None


@dataclass(frozen=True)
class Arguments(Common):
    """Train a variant of BGPO and plot its success."""

    variant: Literal[
        "gwr+r_int", "gwr", "r_int", "none", "even-replay", "experts", "demonstrations", "all"
    ] = "gwr+r_int"
    """Parts of BGPO: gwr+r_int (as published), gwr, r_int or none. On top of gwr+r_int: even-replay
    (over groups of behaviors), experts (even replay and an expert per group), demonstrations
    (replayed as experience), or all."""
    continual: bool = False
    """Present the tasks one after another instead of all from the start."""


def main(arguments: Arguments) -> None:
    """Run a variant."""
    if arguments.algorithm != "bgpo":
        raise ValueError("--algorithm: the variants are BGPO's")
    config = run_config(arguments)
    algorithm = replace(VARIANTS[arguments.variant][1], rl=config.algorithm.rl)
    config = replace(config, name=arguments.variant, algorithm=algorithm)
    if not arguments.continual:
        config = replace(config, task_starts=(0, 0, 0))
    name = "ablation-continual" if arguments.continual else "ablation"
    print(run_experiment(arguments, name, config, make_of(arguments.variant)))


if __name__ == "__main__":
    command_line(main, __doc__, Arguments)
