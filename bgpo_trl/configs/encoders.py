"""Defaults of the encoders."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from bgpo_trl.configs.algorithms import at_least, check, positive
from bgpo_trl.configs.settings import Settings


@dataclass(frozen=True)
class FitConfig(Settings):
    """Settings of any training by Adam."""

    learning_rate: float = 1e-3
    """Peak learning rate of Adam (Sec. IV-A)."""
    warmup_steps: int = 100
    """Steps of linear warm-up. Ours."""
    decay: bool = True
    """Whether a cosine decays the rate to zero. Ours."""

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(self, 1, "warmup_steps")
        positive(self, "learning_rate")


@dataclass(frozen=True)
class VAEConfig(FitConfig):
    """Training of the VAE and its inverse model (stage 1a)."""

    latent_size: int = 64
    """Dimensions of z (Sec. IV-A)."""
    keypoints: bool = True
    """Whether half of z are coordinates of keypoints. Ours: Sec. IV-A has a dense layer alone."""
    batch_size: int = 128
    """Frames per step, in ``batch_size / window`` windows. Ours: 256 in Sec. IV-A; on two cores
    more steps are a better use of the time."""
    window: int = 2
    """Consecutive frames per window. Ours: the inverse model needs pairs, and a window encodes each
    frame only once."""
    learning_rate: float = 2e-3
    """Peak learning rate of Adam. Ours: 1e-4 in Sec. IV-A, too low for so few steps."""
    steps: int = 4_000
    """Gradient steps. Ours: not given in the paper."""
    bfloat16: bool = False
    """Whether to compute in bfloat16, which halves the time on processors and GPUs that have it;
    others compute in float32."""
    reconstruction_weight: float = 1.0
    """Factor of the squared error summed over a frame. Ours: the unit of the other weights."""
    foreground_weight: float = 20.0
    """Further weight of a pixel's error, times its difference to the mean training frame (black and
    white differ by 1). Ours: small objects are seen better with it (docs/learning.md)."""
    kl_weight: float = 0.01
    """Factor of the KL divergence summed over dimensions. Ours: a larger one drops the objects,
    which are 5 pixels wide."""
    inverse_weight: float = 50.0
    """Factor of the inverse model's ``1/2 ||a_hat - a||^2``. Ours: not given in the paper."""

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(self, 1, "latent_size", "batch_size", "steps")
        weights = "reconstruction_weight", "foreground_weight", "kl_weight", "inverse_weight"
        at_least(self, 0, *weights)
        at_least(self, 2, "window")
        divides = self.batch_size % self.window == 0
        check(self, ("window", divides, f"a divisor of batch_size {self.batch_size}"))


@dataclass(frozen=True)
class SequenceAutoencoderConfig(FitConfig):
    """Training of the LSTM autoencoder on latent sequences (stage 1b)."""

    embedding_size: int = 32
    """LSTM units of encoder and decoder, hence dimensions of phi (Sec. IV-A)."""
    batch_size: int = 256
    """Sequences per step (Sec. IV-A)."""
    steps: int = 5_000
    """Gradient steps. Ours: not given in the paper."""

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(self, 1, "embedding_size", "batch_size", "steps")


@dataclass(frozen=True)
class InverseModelConfig(FitConfig):
    """Training of the inverse model on the latents of play (stage 1c). Ours."""

    hidden_size: int = 512
    """Units of each of the two hidden layers."""
    noise: float = 0.1
    """Standard deviation of the noise added to the standardized latents."""
    largest_action: float | None = None
    """Actions with a larger component are left out; None is the scene's ``largest_action``."""
    batch_size: int = 512
    """Windows per step."""
    learning_rate: float = 2e-3
    """Peak learning rate of Adam."""
    steps: int = 6_000
    """Gradient steps; 0 for no inverse model, hence a bank without steps of demonstrations."""

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(self, 1, "hidden_size", "batch_size")
        at_least(self, 0, "steps")
        if self.largest_action is not None:
            positive(self, "largest_action")
        at_least(self, 0, "noise")


@dataclass(frozen=True)
class RepresentationConfig(Settings):
    """Stage 1: both encoders, and the inverse model."""

    vae: VAEConfig = field(default_factory=VAEConfig)
    """The VAE, if it is the frame encoder."""
    lae: SequenceAutoencoderConfig = field(default_factory=SequenceAutoencoderConfig)
    """The sequence encoder."""
    inverse: InverseModelConfig = field(default_factory=InverseModelConfig)
    """The inverse model."""
    frame_network: str = "vae"
    """The frame encoder: vae, or one of FRAME_NETWORKS that the module of --import adds, which is
    not trained further."""
    seed: int = 0
    """Seed of initial weights, batches and sampling noise. Ours."""
    checkpoint_every: int = 250
    """Steps between checkpoints (about a minute). Ours."""
    log_every: int = 20
    """Steps between rows of the log. Ours."""

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(self, 0, "seed")
        at_least(self, 1, "checkpoint_every", "log_every")


STAGE_PRESETS: dict[str, dict[str, Any]] = {
    "smoke": {
        "per_task": 12,
        "held_out_per_task": 4,
        "config": RepresentationConfig(
            vae=VAEConfig(steps=20, batch_size=64),
            lae=SequenceAutoencoderConfig(steps=50, batch_size=32),
            inverse=InverseModelConfig(steps=50, batch_size=32),
        ),
    }
}
"""Presets that run every stage instead of using the shipped encoders, and the arguments with which
`make_pretrained` records demonstrations and trains encoders."""
