"""Defaults, each with its source: section or table of the paper, or "ours" and why."""

from bgpo_trl.configs.algorithms import (
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
from bgpo_trl.configs.encoders import (
    STAGE_PRESETS,
    InverseModelConfig,
    RepresentationConfig,
    SequenceAutoencoderConfig,
    VAEConfig,
)
from bgpo_trl.configs.runs import PRESETS, RunConfig

__all__ = [
    "PRESETS",
    "SHOWN",
    "STAGE_PRESETS",
    "AlgorithmConfig",
    "BGPOConfig",
    "DistNLLConfig",
    "EWCConfig",
    "FineTuningConfig",
    "GWRBConfig",
    "InverseModelConfig",
    "MAMLConfig",
    "RLConfig",
    "RepresentationConfig",
    "RunConfig",
    "SequenceAutoencoderConfig",
    "VAEConfig",
]
