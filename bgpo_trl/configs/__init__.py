"""Defaults, each with its source: section or table of the paper, or "ours" and why."""

from bgpo_trl.configs.algorithms import (
    AlgorithmConfig,
    BGPOConfig,
    DDPGConfig,
    DistNLLConfig,
    EWCConfig,
    FineTuningConfig,
    GWRBConfig,
    MAMLConfig,
    RLConfig,
    SACConfig,
    TD3Config,
)
from bgpo_trl.configs.encoders import (
    STAGE_PRESETS,
    InverseModelConfig,
    RepresentationConfig,
    SequenceAutoencoderConfig,
    StageConfig,
    VAEConfig,
)
from bgpo_trl.configs.runs import PRESETS, RunConfig

__all__ = [
    "PRESETS",
    "STAGE_PRESETS",
    "AlgorithmConfig",
    "BGPOConfig",
    "DDPGConfig",
    "DistNLLConfig",
    "EWCConfig",
    "FineTuningConfig",
    "GWRBConfig",
    "InverseModelConfig",
    "MAMLConfig",
    "RLConfig",
    "RepresentationConfig",
    "RunConfig",
    "SACConfig",
    "SequenceAutoencoderConfig",
    "StageConfig",
    "TD3Config",
    "VAEConfig",
]
