"""LSTM autoencoder over latent sequences: from a demonstration to its embedding phi."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class SequenceAutoencoder(nn.Module):
    """LSTM autoencoder over sequences of latents, the paper's LAE (Sec. III-A).

    The embedding phi is the encoder's hidden state after the last valid latent. The decoder gets
    phi at every step and reconstructs the sequence in reverse order.

    Args:
        latent_size: Dimensions of a latent (paper: 64).
        embedding_size: LSTM units of encoder and decoder, hence dimensions of phi (paper: 32).

    Raises:
        ValueError: If a size is not positive; from methods, if shapes disagree or a length is
            outside 1..T.

    Examples:
        >>> z, length = torch.randn(5, 51, 64), torch.tensor([51, 30, 1, 2, 40])
        >>> SequenceAutoencoder().encode(z, length).shape
        torch.Size([5, 32])
    """

    def __init__(self, latent_size: int = 64, embedding_size: int = 32) -> None:
        if latent_size < 1 or embedding_size < 1:
            raise ValueError(
                f"latent_size and embedding_size must be at least 1, got {latent_size} and "
                f"{embedding_size}"
            )
        super().__init__()
        self.latent_size = latent_size
        self.embedding_size = embedding_size
        self.encoder = nn.LSTM(latent_size, embedding_size, batch_first=True)
        self.decoder = nn.LSTM(embedding_size, embedding_size, batch_first=True)
        self.readout = nn.Linear(embedding_size, latent_size)

    def encode(self, z: Tensor, length: Tensor) -> Tensor:
        """Embed whole sequences; return phi, float32 ``[..., embedding_size]`` in (-1, 1).

        Args:
            z: ``[..., T, latent_size]``; values at or beyond ``length`` are ignored.
            length: Valid latents of each sequence, int64 ``[...]`` in 1..T.
        """
        if length.shape != z.shape[:-2]:
            raise ValueError(
                f"length must be {tuple(z.shape[:-2])} for latents {tuple(z.shape)}, "
                f"got {tuple(length.shape)}"
            )
        steps = z.shape[-2]
        if z.shape[-1] != self.latent_size or length.dtype != torch.int64:
            raise ValueError(
                f"latents must be [..., T, {self.latent_size}] and lengths int64, got "
                f"{[*z.shape]} and {length.dtype}"
            )
        if length.numel() and not (length.min() >= 1 and length.max() <= steps):
            raise ValueError(f"every length must be in 1..{steps}: drop empty sequences")
        # An LSTM is causal: reading its output at the last valid step masks the padding exactly.
        # Without zeros, the gradient of padding that is NaN would be NaN all the same.
        valid = torch.arange(steps, device=z.device) < length.unsqueeze(-1)
        z = torch.where(valid.unsqueeze(-1), z, 0.0)
        hidden, _ = self.encoder(z.reshape(-1, steps, self.latent_size))
        last = (length.reshape(-1, 1, 1) - 1).expand(-1, 1, self.embedding_size)
        return hidden.gather(1, last).reshape(*length.shape, self.embedding_size)

    def step(self, z: Tensor, h: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
        """Advance the encoder by one latent ``[..., latent_size]``; return the new ``h`` and ``c``.

        Both states are ``[..., embedding_size]`` and start as zeros. After the last latent, ``h``
        is phi.
        """
        shape = h.shape
        of_z = (*shape[:-1], self.latent_size)
        if z.shape != of_z or c.shape != shape or shape[-1] != self.embedding_size:
            raise ValueError(
                f"z must be [..., {self.latent_size}], h and c [..., {self.embedding_size}], of "
                f"the same batch, got {[*z.shape]}, {[*shape]} and {[*c.shape]}"
            )
        state = (h.reshape(-1, self.embedding_size), c.reshape(-1, self.embedding_size))
        z = z.reshape(-1, self.latent_size)
        h, c = torch.lstm_cell(z, state, *self.encoder.all_weights[0])
        return h.reshape(shape), c.reshape(shape)

    def decode(self, phi: Tensor, n_steps: int) -> Tensor:
        """Reconstruct ``[..., n_steps, latent_size]`` from each phi, the last latent first."""
        if phi.shape[-1] != self.embedding_size or n_steps < 1:
            raise ValueError(
                f"phi must be [..., {self.embedding_size}] and n_steps at least 1, got "
                f"{[*phi.shape]} and {n_steps}"
            )
        inputs = phi.reshape(-1, 1, self.embedding_size).expand(-1, n_steps, -1)
        hidden, _ = self.decoder(inputs)
        return self.readout(hidden).reshape(*phi.shape[:-1], n_steps, self.latent_size)
