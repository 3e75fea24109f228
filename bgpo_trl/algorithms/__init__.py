"""Algorithms that learn several tasks, by the names that command lines and CSV files give them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from bgpo_trl.algorithms.algorithm import Algorithm
from bgpo_trl.algorithms.bgpo import BGPO, labeled, untold
from bgpo_trl.algorithms.dist_nll import DistNLL
from bgpo_trl.algorithms.maml import MAML
from bgpo_trl.configs import AlgorithmConfig, BGPOConfig, DistNLLConfig, MAMLConfig

__all__ = ["ALGORITHMS", "Algorithm", "Entry"]


@dataclass(frozen=True)
class Entry:
    """How to make an algorithm."""

    make: Callable[..., Algorithm]
    """Called with a config and the arguments of `Algorithm`."""
    config: AlgorithmConfig
    """Its default hyperparameters."""


_SINGLE = BGPOConfig(experts=False, even_replay=False, demonstration_share=0.0)

ALGORITHMS: dict[str, Entry] = {
    "bgpo": Entry(BGPO, BGPOConfig()),
    "bgpo-single": Entry(BGPO, _SINGLE),
    "maml": Entry(MAML, MAMLConfig()),
    "dist-nll": Entry(DistNLL, DistNLLConfig()),
    "oracle": Entry(partial(BGPO, compose=labeled), _SINGLE),
    "ddpg": Entry(partial(BGPO, compose=untold), _SINGLE),
}
"""BGPO; BGPO with one actor and critic for all and without demonstrations; the baselines of the
paper; DDPG that is told the task's label, and DDPG told nothing."""
