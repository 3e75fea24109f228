"""The frame encoder against plain references, its shapes and its scale of latents."""

import pytest
import torch
import torch.nn.functional as F

from bgpo_trl.modules.vae import VAE


@pytest.fixture
def vae() -> VAE:
    torch.manual_seed(0)
    vae = VAE()
    vae.mean_frame.uniform_(0.1, 0.9)
    return vae


def frames(*batch: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, (*batch, 32, 64, 3), dtype=torch.uint8, generator=generator)


def test_the_encoder_is_that_of_the_paper(vae: VAE) -> None:
    """Plain reference: NCHW, three times convolution, ReLU, pooling, in the paper's order."""
    pixels = frames(5)
    x = (pixels.float() / 255 - vae.mean_frame).permute(0, 3, 1, 2).contiguous()
    for layer, channels in zip(vae.encoder, (32, 64, 128), strict=True):
        assert layer.weight.shape[0] == channels
        x = F.max_pool2d(F.relu(F.conv2d(x, layer.weight.contiguous(), layer.bias, padding=1)), 2)
    assert x.shape[1:] == (128, 4, 8)
    mu, log_variance = vae.encode(pixels)
    torch.testing.assert_close(mu[:, 32:], vae.mean_head(x.flatten(1)))
    torch.testing.assert_close(log_variance, vae.log_variance_head(x.flatten(1)))
    assert mu.shape == log_variance.shape == (5, 64)


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


@pytest.mark.parametrize("batch", [(), (3,), (2, 3), (0,), (2, 1, 3)])
def test_leading_dimensions(vae: VAE, batch: tuple[int, ...]) -> None:
    pixels = frames(*batch)
    mu, log_variance = vae.encode(pixels)
    assert mu.shape == log_variance.shape == vae.latent(pixels).shape == (*batch, 64)
    decoded = vae.decode(mu)
    assert decoded.shape == pixels.shape
    assert ((decoded >= 0) & (decoded <= 1)).all()
    action = vae.inverse(mu, mu)
    assert action.shape == (*batch, 4)
    assert (action.abs() <= 1).all()


def test_a_zero_last_layer_decodes_the_mean_frame_within_limits(vae: VAE) -> None:
    vae.mean_frame[:8], vae.mean_frame[8:16], vae.mean_frame[16:] = 0.3, 0.0, 1.0
    vae.decoder[-1].weight.data.zero_()
    vae.decoder[-1].bias.data.zero_()
    shown = vae.decode(torch.randn(1, 64))[0]
    torch.testing.assert_close(shown[:8], torch.full((8, 64, 3), 0.3))
    torch.testing.assert_close(shown[8:16], torch.full((8, 64, 3), 0.02))
    torch.testing.assert_close(shown[16:], torch.full((16, 64, 3), 0.98))


def test_latent_is_standardized_mu_without_gradient(vae: VAE) -> None:
    pixels = frames(40)
    mu, _ = vae.encode(pixels)
    torch.testing.assert_close(vae.latent(pixels), mu, msg="unscaled before training")
    vae.set_latent_scale(mu, floor=0.0)
    latent = vae.latent(pixels)
    assert not latent.requires_grad
    torch.testing.assert_close(latent.mean(0), torch.zeros(64), atol=1e-4, rtol=0)
    torch.testing.assert_close(latent.std(0), torch.ones(64), atol=1e-4, rtol=0)


def test_a_floor_limits_the_scale_of_collapsed_latents(vae: VAE) -> None:
    """Spreads of 2 and 0.001 with a floor of 0.1: the second is divided by 0.2."""
    mu = torch.zeros(2, 64)
    mu[:, 0] = torch.tensor([3.0, 3 + 2 * 2**0.5])
    mu[:, 1] = torch.tensor([0.0, 0.001 * 2**0.5])
    vae.set_latent_scale(mu, floor=0.1)
    torch.testing.assert_close(vae.latent_std, torch.tensor([2.0] + 63 * [0.2]))
    torch.testing.assert_close(vae.latent_mean[0], torch.tensor(3 + 2**0.5))
    other = VAE()
    other.load_state_dict(vae.state_dict())
    assert other.latent_std.equal(vae.latent_std)


@pytest.mark.parametrize(
    "mu",
    [torch.ones(5, 64), torch.full((5, 64), torch.nan), torch.randn(1, 64), torch.randn(3, 2, 64)],
    ids=["constant", "nan", "one-row", "shape"],
)
def test_a_refused_scale_changes_nothing(vae: VAE, mu: torch.Tensor) -> None:
    with pytest.raises(ValueError, match="mu"):
        vae.set_latent_scale(mu)
    assert (vae.latent_mean == 0).all()
    assert (vae.latent_std == 1).all()


def test_a_frame_has_the_same_latent_alone_and_among_many(vae: VAE) -> None:
    frames = torch.randint(256, (2, 75, 32, 64, 3), dtype=torch.uint8)
    latent = vae.latent(frames)
    assert latent.shape == (2, 75, 64)
    torch.testing.assert_close(latent[1, 70], vae.latent(frames[1, 70]))
    assert vae.latent(frames[:0]).shape == (0, 75, 64)
