"""Defaults of the encoders, each with its source."""

from __future__ import annotations

from dataclasses import dataclass, field

from bgpo_trl.configs.checks import at_least, check, positive


@dataclass(frozen=True)
class VAEConfig:
    """Training of the VAE and its inverse model (stage 1a)."""

    latent_size: int = 64
    """Dimensions of z (Sec. IV-A)."""
    batch_size: int = 128
    """Frames a step, drawn as ``batch_size / window`` windows. Ours: 256 in Sec. IV-A, but on two
    cores the time is better spent on more steps."""
    window: int = 2
    """Consecutive frames a window. Ours: the inverse model needs pairs, and a window encodes each
    frame once for both pairs it belongs to."""
    learning_rate: float = 2e-3
    """Peak rate of Adam. Ours: 1e-4 in Sec. IV-A, too slow for so few steps."""
    warmup_steps: int = 100
    """Steps of linear warm-up; cosine decay to zero follows. Ours."""
    steps: int = 2_500
    """Gradient steps. Ours: the paper does not say."""
    reconstruction_weight: float = 1.0
    """Factor of the squared error summed over a frame. Ours."""
    kl_weight: float = 0.01
    """Factor of the KL divergence summed over dimensions."""
    inverse_weight: float = 50.0
    """Factor of the inverse model's ``1/2 ||a_hat - a||^2``."""

    def __post_init__(self) -> None:
        at_least(self, 1, "latent_size", "batch_size", "warmup_steps", "steps")
        positive(self, "learning_rate")
        at_least(self, 0, "reconstruction_weight", "kl_weight", "inverse_weight")
        divides = self.window >= 2 and self.batch_size % self.window == 0
        check(self, ("window", divides, f"at least 2 and divide batch_size {self.batch_size}"))


@dataclass(frozen=True)
class SequenceAutoencoderConfig:
    """Training of the LSTM autoencoder on latent sequences (stage 1b)."""

    embedding_size: int = 32
    """LSTM units of encoder and decoder, so dimensions of phi (Sec. IV-A)."""
    batch_size: int = 256
    """Sequences a step (Sec. IV-A)."""
    learning_rate: float = 1e-3
    """Peak rate of Adam (Sec. IV-A)."""
    warmup_steps: int = 100
    """Steps of linear warm-up; cosine decay to zero follows. Ours."""
    steps: int = 5_000
    """Gradient steps. Ours: the paper does not say."""

    def __post_init__(self) -> None:
        at_least(self, 1, "embedding_size", "batch_size", "warmup_steps", "steps")
        positive(self, "learning_rate")


@dataclass(frozen=True)
class RepresentationConfig:
    """Stage 1: both encoders."""

    vae: VAEConfig = field(default_factory=VAEConfig)
    """The frame encoder."""
    lae: SequenceAutoencoderConfig = field(default_factory=SequenceAutoencoderConfig)
    """The sequence encoder."""
    seed: int = 0
    """Seed of initial weights, batches and sampling noise. Ours."""
    checkpoint_every: int = 250
    """Steps between checkpoints (about a minute each). Ours."""
    log_every: int = 20
    """Steps between rows of the log. Ours."""

    def __post_init__(self) -> None:
        at_least(self, 0, "seed")
        at_least(self, 1, "checkpoint_every", "log_every")


@dataclass(frozen=True)
class StageConfig:
    """Stage 1 of a preset that makes its own encoders."""

    per_task: int
    """Demonstrations of each task."""
    held_out_per_task: int
    """How many of those are held out."""
    config: RepresentationConfig
    """Training of the encoders."""


STAGE_PRESETS: dict[str, StageConfig] = {
    "smoke": StageConfig(
        per_task=12,
        held_out_per_task=4,
        config=RepresentationConfig(
            vae=VAEConfig(steps=20, batch_size=64),
            lae=SequenceAutoencoderConfig(steps=50, batch_size=32),
        ),
    )
}
"""Presets that go through every stage from nothing instead of using the shipped encoders."""
