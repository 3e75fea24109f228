"""The sequence autoencoder against a plain LSTM, streaming, and padding."""

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from bgpo_trl.modules.sequence_autoencoder import SequenceAutoencoder

LENGTH = torch.tensor([51, 1, 2, 30, 50])


@pytest.fixture
def lae() -> SequenceAutoencoder:
    torch.manual_seed(0)
    return SequenceAutoencoder()


def sequences(*batch: int) -> Tensor:
    return torch.randn(*batch, 51, 64, generator=torch.Generator().manual_seed(1))


def plain_lstm(x: Tensor, weights: list[Tensor]) -> Tensor:
    """The textbook LSTM, one step at a time: ``[B, T, d]`` to all hidden states ``[B, T, H]``."""
    w_input, w_hidden, b_input, b_hidden = weights
    h = c = torch.zeros(len(x), w_hidden.shape[1])
    states = []
    for x_t in x.unbind(1):
        gates = F.linear(x_t, w_input, b_input) + F.linear(h, w_hidden, b_hidden)
        i, f, g, o = gates.chunk(4, -1)
        c = f.sigmoid() * c + i.sigmoid() * g.tanh()
        h = o.sigmoid() * c.tanh()
        states.append(h)
    return torch.stack(states, 1)


def test_phi_is_the_hidden_state_after_the_last_valid_latent(lae: SequenceAutoencoder) -> None:
    z = sequences(5)
    states = plain_lstm(z, lae.encoder.all_weights[0])
    phi = lae.encode(z, LENGTH)
    assert phi.shape == (5, 32)
    torch.testing.assert_close(phi, states[torch.arange(5), LENGTH - 1])
    assert (phi.abs() < 1).all()


def test_streaming_equals_batch(lae: SequenceAutoencoder) -> None:
    z = sequences(2, 5)
    length = LENGTH.expand(2, 5)
    h = c = torch.zeros(2, 5, 32)
    phi = torch.zeros(2, 5, 32)
    for t in range(51):
        h, c = lae.step(z[:, :, t], h, c)
        phi = torch.where((length == t + 1).unsqueeze(-1), h, phi)
    torch.testing.assert_close(phi, lae.encode(z, length))


@pytest.mark.parametrize("filler", [0.0, 7.0, torch.nan])
def test_latents_beyond_the_length_have_no_influence(
    lae: SequenceAutoencoder, filler: float
) -> None:
    z = sequences(5)
    padded = z.masked_fill((torch.arange(51) >= LENGTH.unsqueeze(-1)).unsqueeze(-1), filler)
    torch.testing.assert_close(lae.encode(padded, LENGTH), lae.encode(z, LENGTH))


def test_decoder_is_fed_phi_at_every_step(lae: SequenceAutoencoder) -> None:
    phi = torch.rand(3, 32) * 2 - 1
    states = plain_lstm(phi.unsqueeze(1).expand(-1, 9, -1), lae.decoder.all_weights[0])
    torch.testing.assert_close(lae.decode(phi, 9), lae.readout(states))
    torch.testing.assert_close(lae.decode(phi[0], 4), lae.decode(phi, 9)[0, :4])
    assert lae.decode(phi.expand(2, 3, 32), 5).shape == (2, 3, 5, 64)
