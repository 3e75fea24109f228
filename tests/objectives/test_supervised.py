"""Losses of the encoders against numbers by hand, and the noise, padding and gradients."""

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor

from bgpo_trl.configs import VAEConfig
from bgpo_trl.modules.inverse_model import InverseModel
from bgpo_trl.modules.sequence_autoencoder import SequenceAutoencoder
from bgpo_trl.objectives.supervised import (
    action_inference_loss,
    distillation_loss,
    sequence_reconstruction_loss,
    vae_inverse_loss,
)


def hand_vae(mu: Tensor, log_variance: Tensor, grey: float = 0.0) -> Any:
    """Two latents with known posterior; decodes to a constant; the action is ``z_next - z``."""
    return SimpleNamespace(
        mean_frame=torch.zeros(32, 64, 3),
        encode=lambda pixels: (mu, log_variance),
        decode=lambda z: torch.full((*z.shape[:-1], 32, 64, 3), grey),
        inverse=lambda z, z_next: z_next - z,
    )


def windows(n: int = 2, k: int = 3, n_actions: int = 4) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    pixels = torch.randint(0, 256, (n, k, 32, 64, 3), dtype=torch.uint8, generator=generator)
    action = torch.rand(n, k, n_actions, generator=generator) * 2 - 1
    return TensorDict({"pixels": pixels, "action": action}, [n, k])


def test_hand_computed_numbers() -> None:
    mu = torch.tensor([[[1.0, 0.0], [1.0, 2.0], [3.0, 2.0]]])
    log_variance = torch.full_like(mu, -80.0)  # so that z is mu to float precision
    data = windows(1, 3, 2)
    data["pixels"] = torch.full_like(data["pixels"], 51)  # 0.2
    data["action"] = torch.tensor([[[0.0, 1.0], [2.0, 1.0], [torch.nan, torch.nan]]])
    result = vae_inverse_loss(
        hand_vae(mu, log_variance, grey=0.3),
        data,
        VAEConfig(
            reconstruction_weight=2.0, foreground_weight=0.0, kl_weight=0.5, inverse_weight=3.0
        ),
    )
    # Transitions [0, 2] against [0, 1], and [2, 0] against [2, 1]; the last action is not read.
    assert result["inverse"].item() == pytest.approx(0.5)
    assert result["reconstruction"].item() == pytest.approx(6144 * 0.1**2, rel=1e-4)
    # Squares 1, 5, 13 of three frames; each of two dimensions adds 80 - 1.
    assert result["kl"].item() == pytest.approx(((1 + 5 + 13) / 3 + 2 * 79) / 2)
    assert result["loss_inverse"].item() == pytest.approx(1.5)
    assert result["loss_reconstruction"].item() == pytest.approx(2 * 61.44, rel=1e-4)
    assert result["loss_kl"].item() == pytest.approx(result["kl"].item() / 2)


def test_pixels_that_differ_from_the_mean_frame_weigh_more() -> None:
    vae = hand_vae(torch.zeros(1, 3, 2), torch.zeros(1, 3, 2), grey=0.3)
    data = windows(1, 3, 2)
    data["pixels"] = torch.full_like(data["pixels"], 51)  # 0.2
    vae.mean_frame = torch.full((32, 64, 3), 0.2)
    vae.mean_frame[3, 5] = torch.tensor([0.2, 0.5, 0.1])
    vae.mean_frame[8, 9] = 0.25
    result = vae_inverse_loss(vae, data, VAEConfig(foreground_weight=7.0))
    assert result["reconstruction"].item() == pytest.approx(6144 * 0.1**2, rel=1e-4)
    counted = (6144 + 7 * 3 * (0.3 + 0.05)) * 0.1**2
    assert result["loss_reconstruction"].item() == pytest.approx(counted, rel=1e-4)


def test_latents_are_sampled_with_the_posteriors_standard_deviation() -> None:
    """With actions zero the inverse loss is half the variance of z_next - z: sigma^2 a number."""
    mu, log_variance = torch.zeros(4, 3, 1000), torch.full((4, 3, 1000), 2 * math.log(0.3))
    generator = torch.Generator().manual_seed(0)
    vae = hand_vae(mu, log_variance)
    data = windows(4, 3, 1000)
    data["action"].zero_()
    loss = vae_inverse_loss(vae, data, VAEConfig(), generator=generator)
    assert loss["inverse"].item() == pytest.approx(1000 * 0.3**2, rel=0.05)


def test_only_known_actions_train_the_inverse_model() -> None:
    """Zeros in and out: the loss is half the squared norm of the known actions, on average."""
    mu = torch.zeros(3, 3, 4)
    vae = hand_vae(mu, torch.full((3, 3, 4), -100.0))
    known = torch.tensor([True, False, True])
    data = TensorDict({**windows(3), "action_known": known}, [3])
    expected = data["action"][[0, 2], :2].square().sum(-1).mean() / 2
    loss = vae_inverse_loss(vae, data, VAEConfig())
    assert loss["inverse"] == pytest.approx(expected.item())
    data["action"][1] = torch.nan  # whatever stands for an unknown action
    assert vae_inverse_loss(vae, data, VAEConfig())["inverse"] == loss["inverse"]
    with pytest.raises(ValueError, match=r"action_known must be \[3\], got \[3, 1\]"):
        wrong = data.clone().set("action_known", known.unsqueeze(-1))
        vae_inverse_loss(vae, wrong, VAEConfig())
    data["action_known"][:] = False
    assert vae_inverse_loss(vae, data, VAEConfig())["inverse"] == 0


def test_action_inference_loss_is_the_squared_error() -> None:
    torch.manual_seed(0)
    inverse = InverseModel(2, 3, hidden_size=4)
    data = TensorDict({"window": torch.randn(5, 16), "action": torch.rand(5, 3)}, [5])
    error = inverse.network(data["window"]) - data["action"]
    loss = action_inference_loss(inverse, data)["loss_inverse"]
    assert loss.item() == pytest.approx(error.square().sum().item() / 5)


def given(reconstruction: Tensor) -> Any:
    """Reconstructs given latents, in reverse order, whatever the code."""
    return SimpleNamespace(
        encode=lambda z, length: z[..., 0, :],
        decode=lambda phi, n_steps: reconstruction[..., :n_steps, :],
    )


def test_sequence_loss_by_hand() -> None:
    latent = torch.tensor([[[1.0, 2.0], [3.0, 4.0], [9.0, 9.0]], [[5.0, 6.0], [9.0, 9.0], [9, 9]]])
    data = TensorDict({"latent": latent, "length": torch.tensor([2, 1])}, [2])
    backwards = torch.tensor([[[3.0, 4.0], [1.0, 2.0]], [[5.0, 6.0], [-7.0, 7.0]]])
    key = "loss_reconstruction"
    assert sequence_reconstruction_loss(given(backwards), data)[key] == 0
    backwards[0, 1] += torch.tensor([3.0, 0.0])
    backwards[1, 0] += torch.tensor([0.0, 1.0])
    # Squares 9 and 1 over three valid steps of two numbers.
    loss = sequence_reconstruction_loss(given(backwards), data)
    assert loss[key].item() == pytest.approx(10 / 6)
    loss = sequence_reconstruction_loss(given(backwards[:1]), data[:1])
    assert loss[key].item() == pytest.approx(9 / 4)


def test_sequence_loss_and_gradient_ignore_padding() -> None:
    torch.manual_seed(0)
    lae = SequenceAutoencoder()
    length = torch.tensor([7, 1, 51])
    latent = torch.randn(3, 51, 64)
    beyond = (torch.arange(51) >= length.unsqueeze(-1)).unsqueeze(-1)
    gradients = []
    for z in (latent, latent.masked_fill(beyond, 100.0), latent.masked_fill(beyond, math.nan)):
        lae.zero_grad()
        data = TensorDict({"latent": z, "length": length}, [3])
        value = sequence_reconstruction_loss(lae, data)["loss_reconstruction"]
        value.backward()
        gradients.append([value.detach(), *(p.grad.clone() for p in lae.parameters())])
    torch.testing.assert_close(gradients[1], gradients[0])
    torch.testing.assert_close(gradients[2], gradients[0])


# Two tasks, three states of each, two action components.
MEAN = [[[0.0, 0.5], [-0.25, 1.0], [0.1, 0.2]], [[0.0, 0.0], [0.75, -0.5], [-1.0, 0.3]]]
SCALE = [[[0.1, 0.2], [1.0, 0.5], [0.3, 0.3]], [[0.25, 1.0], [0.4, 0.1], [0.15, 0.9]]]
ACTION = [[[0.2, 0.5], [0.25, 0.0], [-0.4, 0.8]], [[0.0, 1.0], [0.7, -0.4], [-1.0, -0.6]]]


# A policy whose states are the parameters of its distributions.
POLICY = TensorDictModule(lambda given: given.unbind(-1), ["parameters"], ["loc", "scale"])


def given_batch():
    parameters = torch.stack([torch.tensor(MEAN), torch.tensor(SCALE)], -1)
    batch = {
        "parameters": parameters.requires_grad_(),
        "teacher_action": torch.tensor(ACTION).requires_grad_(),
    }
    return TensorDict(batch, [2, 3])


def test_the_loss_is_the_negative_log_likelihood_of_the_teachers_actions():
    batch = given_batch()
    mean, scale, action = (torch.tensor(values) for values in (MEAN, SCALE, ACTION))
    nll = 0.5 * (2 * math.pi * scale**2).log() + (action - mean) ** 2 / (2 * scale**2)
    loss = distillation_loss(POLICY, batch)
    torch.testing.assert_close(loss, nll.sum() / 3)  # a mean over the states, a sum over the rest
    assert set(batch.keys()) == {"parameters", "teacher_action"}
    loss.backward()
    error = mean - action
    expected = torch.stack([error / scale**2, 1 / scale - error**2 / scale**3], -1) / 3
    torch.testing.assert_close(batch["parameters"].grad, expected)
    assert batch["teacher_action"].grad is None


def test_weights_are_factors_of_the_losses_of_states():
    batch = given_batch()
    whole = distillation_loss(POLICY, batch)
    weights = torch.tensor([[1.0, 1.0, 1.0], [0.0, 0.0, 0.0]])
    first = distillation_loss(POLICY, batch.set("priority_weight", weights))
    second = distillation_loss(POLICY, batch.set("priority_weight", 1 - weights))
    torch.testing.assert_close(first + second, whole)
    first.backward()
    assert (batch["parameters"].grad[0] != 0).any() and (batch["parameters"].grad[1] == 0).all()


def test_entries_that_would_broadcast_are_refused():
    for entry in ("teacher_action", "priority_weight"):
        batch = given_batch()
        batch[entry] = torch.ones(2, 3, 1)
        with pytest.raises(ValueError, match=entry):
            distillation_loss(POLICY, batch)
