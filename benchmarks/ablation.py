"""The paper's third experiment: BGPO without GWR-B, without the intrinsic reward, without both.

Besides: what experts, even replay and demonstrations add to it.

    python benchmarks/ablation.py --variant r_int --preset quick

The variants differ by the transforms below and by nothing else (Fig. 9). All tasks are presented
from the start.
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
    """Returns what stands in for GWR-B: the demonstration's embedding is the behavior."""
    return RenameTransform(["demo_embedding"], ["behavior"], create_copy=True)


def published(parts: Parts) -> Composition:
    """BGPO's own composition, with GWR-B and the intrinsic reward."""
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
"""The transforms and the settings of each variant. The first four are the paper's; the others add
what it does not have, one thing at a time, and all of it."""


def make_of(name: str) -> Callable[..., BGPO] | None:
    """Returns the function that makes the variant of that name; None for another name."""
    return partial(BGPO, compose=VARIANTS[name][0]) if name in VARIANTS else None


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
    algorithm = replace(VARIANTS[arguments.variant][1], rl=config.algorithm.rl)
    config = replace(config, name=arguments.variant, algorithm=algorithm)
    if not arguments.continual:
        config = replace(config, task_starts=(0, 0, 0))
    name = "ablation-continual" if arguments.continual else "ablation"
    print(run_experiment(arguments, name, config, make_of(arguments.variant)))


if __name__ == "__main__":
    command_line(main, __doc__, Arguments)
