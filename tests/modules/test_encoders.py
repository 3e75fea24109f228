"""The encoders against plain references: of frames, of sequences, and of actions."""

from copy import deepcopy

import pytest
import torch
import torch.nn.functional as F

from bgpo_trl.modules.inverse_model import InverseModel, window
from bgpo_trl.modules.sequence_autoencoder import SequenceAutoencoder
from bgpo_trl.modules.vae import VAE


@pytest.fixture
def vae() -> VAE:
    torch.manual_seed(0)
    vae = VAE()
    vae.mean_frame.uniform_(0.1, 0.9)
    return vae


def frames(*batch: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.randint(0, 256, (*batch, 32, 64, 3), dtype=torch.uint8, generator=generator)


def plain_convolutions(vae: VAE, pixels: torch.Tensor) -> torch.Tensor:
    """Plain reference: NCHW, three times convolution, ReLU, pooling, in the paper's order."""
    x = (pixels.float() / 255 - vae.mean_frame).permute(0, 3, 1, 2).contiguous()
    for layer in vae.encoder:
        x = F.max_pool2d(F.relu(F.conv2d(x, layer.weight.contiguous(), layer.bias, padding=1)), 2)
    return x


def test_the_encoder_is_that_of_the_paper(vae: VAE) -> None:
    pixels = frames(5)
    x = plain_convolutions(vae, pixels)
    assert [layer.weight.shape[0] for layer in vae.encoder] == [32, 64, 128]
    assert x.shape[1:] == (128, 4, 8)
    mu, log_variance = vae.encode(pixels)
    torch.testing.assert_close(mu[:, 32:], vae.mean_head(x.flatten(1)))
    torch.testing.assert_close(log_variance, vae.log_variance_head(x.flatten(1)))
    assert mu.shape == log_variance.shape == (5, 64)


def test_without_keypoints_means_are_those_of_a_dense_layer_and_decoded_by_layers() -> None:
    torch.manual_seed(0)
    vae, pixels = VAE(keypoints=False), frames(5)
    mu = vae.encode(pixels)[0]
    torch.testing.assert_close(mu, vae.mean_head(plain_convolutions(vae, pixels).flatten(1)))
    assert mu.shape == (5, 64)
    x = F.relu(vae.decoder_dense(mu)).unflatten(-1, (128, 4, 8))
    for layer in vae.decoder[:-1]:
        x = F.relu(layer(x))
    x = torch.sigmoid(vae.decoder[-1](x)).permute(0, 2, 3, 1)
    torch.testing.assert_close(vae.decode(mu), x)
    assert not any("keypoint" in name or "place" in name for name in vae.state_dict())


def test_keypoints_are_expected_places_and_decode_to_blobs_there(vae: VAE) -> None:
    """One bright cell in a map of keypoint k: its place in the latent, and the blob's maximum."""
    for cell in [(0, 0), (15, 31), (4, 20)]:
        maps = torch.zeros(1, 16, 16, 32)
        maps[0, 5][cell] = 100.0
        vae.keypoint_maps.forward = lambda _, maps=maps: maps  # type: ignore[method-assign]
        mu = vae.encode(frames(1))[0]
        row, column = -1 + 2 * cell[0] / 15, -2 + 4 * cell[1] / 31
        torch.testing.assert_close(mu[0, [5, 21]], torch.tensor([1.5 * column, 3.0 * row]))
        others = [i for i in range(32) if i not in (5, 21)]
        torch.testing.assert_close(mu[0, others], torch.zeros(30), rtol=0, atol=1e-5)
        blob = vae._blobs(mu)[0, 5]
        assert divmod(int(blob.argmax()), 32) == cell
        torch.testing.assert_close(blob.max(), torch.tensor(1.0))


def test_a_zero_last_layer_decodes_the_mean_frame_within_limits(vae: VAE) -> None:
    vae.mean_frame[:8], vae.mean_frame[8:16], vae.mean_frame[16:] = 0.3, 0.0, 1.0
    vae.decoder[-1].weight.data.zero_()
    vae.decoder[-1].bias.data.zero_()
    shown = vae.decode(torch.randn(1, 64))[0]
    torch.testing.assert_close(shown[:8], torch.full((8, 64, 3), 0.3))
    torch.testing.assert_close(shown[8:16], torch.full((8, 64, 3), 0.02))
    torch.testing.assert_close(shown[16:], torch.full((16, 64, 3), 0.98))


def test_a_floor_limits_the_scale_of_collapsed_latents(vae: VAE) -> None:
    """Spreads of 2 and 0.001 with a floor of 0.1: the second is divided by 0.2."""
    mu = torch.zeros(2, 64)
    mu[:, 0] = torch.tensor([3.0, 3 + 2 * 2**0.5])
    mu[:, 1] = torch.tensor([0.0, 0.001 * 2**0.5])
    vae.set_latent_scale(mu, floor=0.1)
    torch.testing.assert_close(vae.latent_std, torch.tensor([2.0] + 63 * [0.2]))
    torch.testing.assert_close(vae.latent_mean[0], torch.tensor(3 + 2**0.5))
    before = vae.latent_std.clone(), vae.latent_mean.clone()
    for bad in (torch.ones(5, 64), mu * torch.nan, torch.randn(1, 64), torch.randn(3, 2, 64)):
        with pytest.raises(ValueError, match="features"):
            vae.set_latent_scale(bad)
    assert vae.latent_std.equal(before[0]) and vae.latent_mean.equal(before[1])


def test_a_frame_has_the_same_latent_alone_and_among_many(vae: VAE) -> None:
    many = frames(2, 75)
    latent = vae.latent(many)
    assert latent.shape == (2, 75, 64)
    torch.testing.assert_close(latent[1, 70], vae.latent(many[1, 70]))


# ---- the sequence autoencoder


LENGTH = torch.tensor([51, 1, 2, 30, 50])


@pytest.fixture
def lae() -> SequenceAutoencoder:
    torch.manual_seed(0)
    return SequenceAutoencoder()


def sequences(*batch: int) -> torch.Tensor:
    return torch.randn(*batch, 51, 64, generator=torch.Generator().manual_seed(1))


def plain_lstm(x: torch.Tensor, weights: list[torch.Tensor]) -> torch.Tensor:
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


def test_decoder_is_fed_phi_at_every_step(lae: SequenceAutoencoder) -> None:
    phi = torch.rand(3, 32) * 2 - 1
    states = plain_lstm(phi.unsqueeze(1).expand(-1, 9, -1), lae.decoder.all_weights[0])
    torch.testing.assert_close(lae.decode(phi, 9), lae.readout(states))
    torch.testing.assert_close(lae.decode(phi[0], 4), lae.decode(phi, 9)[0, :4])
    assert lae.decode(phi.expand(2, 3, 32), 5).shape == (2, 3, 5, 64)


# ---- the inverse model


def test_a_window_holds_the_latents_around_a_step_within_the_episode() -> None:
    """Plain reference: lists; before the first and after the last latent, that one repeats."""
    generator = torch.Generator().manual_seed(0)
    z, length = torch.randn(3, 6, 2, generator=generator), torch.tensor([6, 4, 2])
    for episode, step in [(0, 0), (0, 2), (0, 4), (1, 0), (1, 2), (2, 0)]:
        latents = z[episode, : length[episode]].tolist()
        places = [min(max(step + k, 0), len(latents) - 1) for k in range(-3, 5)]
        expected = [value for place in places for value in latents[place]]
        found = window(z, length, torch.tensor(episode), torch.tensor(step))
        assert found.tolist() == expected


def test_the_actions_of_an_episode_are_those_of_its_windows() -> None:
    torch.manual_seed(0)
    model = InverseModel(3, 2, hidden_size=8)
    generator = torch.Generator().manual_seed(0)
    z, length = torch.randn(2, 5, 3, generator=generator), torch.tensor([5, 3])
    action = model(z, length)
    assert action.shape == (2, 4, 2)
    elsewhere = deepcopy(model).to("meta")(z.to("meta"), length.to("meta"))
    assert elsewhere.shape == action.shape and elsewhere.is_meta
    for episode, step in [(0, 0), (0, 3), (1, 1)]:
        alone = model.network(window(z, length, torch.tensor(episode), torch.tensor(step)))
        torch.testing.assert_close(action[episode, step], alone.clamp(-1.0, 1.0))
