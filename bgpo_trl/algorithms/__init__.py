"""Algorithms that learn several tasks, by their names in command lines and CSV files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from bgpo_trl.algorithms.algorithm import Algorithm
from bgpo_trl.algorithms.bgpo import BGPO
from bgpo_trl.algorithms.dist_nll import DistNLL
from bgpo_trl.algorithms.ewc import EWC, FineTuning
from bgpo_trl.algorithms.maml import MAML
from bgpo_trl.configs import (
    SHOWN,
    AlgorithmConfig,
    BGPOConfig,
    DistNLLConfig,
    EWCConfig,
    FineTuningConfig,
    GWRBConfig,
    MAMLConfig,
    RLConfig,
)

__all__ = ["ABLATIONS", "ALGORITHMS", "Algorithm", "Entry", "entry"]


@dataclass(frozen=True)
class Entry:
    """An algorithm and its default hyperparameters."""

    make: Callable[..., Algorithm]
    """Called with a config and the arguments of `Algorithm`."""
    config: AlgorithmConfig
    """The default hyperparameters."""


_ALONE: Any = {"demonstration_share": 0.0, "expert_batch_size": 64, "rl": RLConfig()}
_SINGLE = BGPOConfig(experts=False, group_balanced_replay=False, **_ALONE)
_PAPER = RLConfig(
    hidden_sizes=(64,),
    critic_layer_norm=False,
    batch_size=256,
    clip_targets=False,
    pre_tanh_penalty=0.0,
)
_LITERAL: Any = {"rl": _PAPER, "timeouts_bootstrap": False, "state_limit": None}
_PUBLISHED: Any = {**_LITERAL, "gwr": GWRBConfig(activity_scale=1.0), "behavior_scale": 1.0}
_OF_TASKS: Any = {**_LITERAL, "task_batch_size": 256, "share_batch": True}
_SHOWN: Any = {"demonstration_share": 0.5, "rl": SHOWN}
_SHOWN_TASKS: Any = {**_SHOWN, "task_batch_size": 128}
_SHOWN_SINGLE: Any = {**_SHOWN, "rl": replace(SHOWN, batch_size=384)}  # of three tasks
_CLONE: Any = {"rl": replace(SHOWN, proposals="clone")}
# MAML adapts one policy, which imitates and ascends its critics at once. Imitation makes the
# gradient by which it adapts as much larger.
_MAML: Any = {
    **_SHOWN_TASKS,
    "rl": replace(SHOWN, proposals="actor", imitation=50.0, imitation_half_life=None),
    "inner_learning_rate": MAMLConfig.inner_learning_rate / 50.0,
}

ALGORITHMS: dict[str, Entry] = {
    "bgpo": Entry(BGPO, BGPOConfig()),
    "clone": Entry(BGPO, BGPOConfig(**_CLONE)),
    "bgpo-experts": Entry(BGPO, BGPOConfig(**_ALONE)),
    "bgpo-single": Entry(BGPO, _SINGLE),
    "bgpo-paper": Entry(BGPO, replace(_SINGLE, **_PUBLISHED)),
    "maml": Entry(MAML, MAMLConfig()),
    "maml-demonstrations": Entry(MAML, MAMLConfig(**_MAML)),
    "maml-paper": Entry(
        MAML, MAMLConfig(**_OF_TASKS, adaptation_size=256 * 50, adapt_to_latest=True)
    ),
    "dist-nll": Entry(DistNLL, DistNLLConfig()),
    "dist-nll-demonstrations": Entry(DistNLL, DistNLLConfig(**_SHOWN_TASKS)),
    "dist-nll-paper": Entry(DistNLL, DistNLLConfig(**_OF_TASKS, distillation_batch_size=256)),
    "oracle": Entry(BGPO, replace(_SINGLE, context="label")),
    "oracle-demonstrations": Entry(BGPO, replace(_SINGLE, context="label", **_SHOWN_SINGLE)),
    "ddpg": Entry(BGPO, replace(_SINGLE, context=None)),
    "fine-tuning": Entry(FineTuning, FineTuningConfig()),
    "fine-tuning-demonstrations": Entry(FineTuning, FineTuningConfig(**_SHOWN)),
    "ewc": Entry(EWC, EWCConfig()),
    "ewc-demonstrations": Entry(EWC, EWCConfig(**_SHOWN)),
    "without-bonus": Entry(BGPO, replace(_SINGLE, beta=0.0)),
    "without-gwr": Entry(BGPO, replace(_SINGLE, context="embedding")),
    "without-both": Entry(BGPO, replace(_SINGLE, context="embedding", beta=0.0)),
    "group-balanced-replay": Entry(BGPO, replace(_SINGLE, group_balanced_replay=True)),
    "demonstrations": Entry(BGPO, replace(_SINGLE, **_SHOWN_SINGLE)),
}
"""BGPO; ``clone``, BGPO without reward, which imitates alone; ``bgpo-experts``, BGPO without
demonstrations as experience; ``bgpo-single``, which in addition has only one actor and one critic;
the paper's baselines, without and with demonstrations; two references, DDPG with the task's label
(``oracle``) and without context (``ddpg``); two baselines of continual learning, which are given
the boundaries of tasks (``fine-tuning``, ``ewc``). Names in ``-demonstrations`` learn from
demonstrations as BGPO does. Names in ``-paper`` follow the publication (docs/protocol.md): networks
of 64 units, batches of 256, no stabilizers. The others are ``bgpo-single`` without GWR-B, the
intrinsic reward or both, or with one addition of this package. Modules of own algorithms may add
entries."""

ABLATIONS = (
    "bgpo-single",
    "without-bonus",
    "without-gwr",
    "without-both",
    "group-balanced-replay",
    "demonstrations",
    "bgpo-experts",
    "bgpo",
)
"""The arms of the paper's ablation (Fig. 9), of ``bgpo-single``: with GWR-B and the intrinsic
reward, one of them, neither. Then each addition of this package, and all of them together. Fig. 9
as published is ``bgpo-paper`` with ``context="embedding"`` and ``beta=0``."""


def entry(name: str) -> Entry:
    """Return the entry of an algorithm; raise ``ValueError`` if the name is unknown."""
    if name not in ALGORITHMS:
        raise ValueError(
            f"no algorithm {name!r}: choose one of {', '.join(ALGORITHMS)}, or name the module "
            "that adds it with --import"
        )
    return ALGORITHMS[name]
