"""Every default in one place, each with its source: the paper's section, or "ours" and why."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class VAEConfig:
    """Training of the VAE and its inverse model (stage 1a)."""

    latent_size: int = 64
    """Dimensions of z (Sec. IV-A)."""
    batch_size: int = 256
    """Frames a step (Sec. IV-A), drawn as ``batch_size / window`` windows."""
    window: int = 4
    """Consecutive frames a window. Ours: the inverse model needs pairs, and a window encodes each
    frame once for both pairs it belongs to."""
    learning_rate: float = 1e-3
    """Peak rate of Adam."""
    warmup_steps: int = 100
    """Steps of linear warm-up; cosine decay to zero follows. Ours."""
    steps: int = 5_000
    """Gradient steps. Ours: the paper does not say."""
    reconstruction_weight: float = 1.0
    """Factor of the squared error summed over a frame. Ours."""
    kl_weight: float = 0.01
    """Factor of the KL divergence summed over dimensions."""
    inverse_weight: float = 10.0
    """Factor of the inverse model's ``1/2 ||a_hat - a||^2``."""


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
