"""The paper's third experiment: BGPO without GWR-B, without the intrinsic reward, without both.

    python benchmarks/ablation.py --variant r_int --preset quick

The variants differ by the transforms below and by nothing else (Fig. 9). All tasks are presented
from the start.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

from experiment import Arguments as Common
from experiment import command_line, run_config, run_experiment
from torchrl.envs import RenameTransform

from bgpo_trl.algorithms.bgpo import BGPO, Composition, Parts
from bgpo_trl.transforms import BehaviorLookup


def demonstration_itself() -> RenameTransform:
    """Returns what stands in for GWR-B: the demonstration's embedding is the behavior."""
    return RenameTransform(["demo_embedding"], ["behavior"], create_copy=True)


VARIANTS: dict[str, Callable[[Parts], Composition]] = {
    "gwr+r_int": lambda parts: Composition(
        infer=[BehaviorLookup(parts.gwr, learn=True)],
        reward=[parts.behavior_matching_reward()],
    ),
    "gwr": lambda parts: Composition(
        infer=[BehaviorLookup(parts.gwr, learn=True)],
    ),
    "r_int": lambda parts: Composition(
        infer=[demonstration_itself()],
        reward=[parts.behavior_matching_reward()],
    ),
    "none": lambda parts: Composition(
        infer=[demonstration_itself()],
    ),
}


def make_of(name: str) -> Callable[..., BGPO] | None:
    """Returns what makes the variant of that name; None for what is no variant."""
    return partial(BGPO, compose=VARIANTS[name]) if name in VARIANTS else None


@dataclass(frozen=True)
class Arguments(Common):
    """Trains a variant of BGPO and draws its success."""

    variant: Literal["gwr+r_int", "gwr", "r_int", "none"] = "gwr+r_int"
    """GWR-B and the intrinsic reward; one of them; or none."""


def main(arguments: Arguments) -> None:
    """Runs a variant."""
    if arguments.algorithm != "bgpo":
        raise ValueError("--algorithm: the variants are BGPO's")
    config = replace(run_config(arguments), name=arguments.variant, task_starts=(0, 0, 0))
    run_experiment(arguments, "ablation", config, make_of(arguments.variant))


if __name__ == "__main__":
    command_line(main, __doc__, Arguments)
