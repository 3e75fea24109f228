"""Losses of supervised learning: the encoders (paper, Sec. III-A) and distillation."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.nn.functional import gaussian_nll_loss

from bgpo_trl.configs import VAEConfig
from bgpo_trl.errors import missing_key
from bgpo_trl.modules.inverse_model import InverseModel
from bgpo_trl.modules.sequence_autoencoder import SequenceAutoencoder
from bgpo_trl.modules.vae import VAE


def _entries(reader: str, batch: TensorDictBase, keys: Sequence[NestedKey]) -> list[Tensor]:
    """Return some entries of a batch; raise ``ValueError`` if one is missing."""
    if any(batch.get(key, None) is None for key in keys):
        raise missing_key(reader, batch, keys)
    return [batch.get(key) for key in keys]


def vae_inverse_loss(
    vae: VAE,
    windows: TensorDictBase,
    config: VAEConfig,
    *,
    generator: torch.Generator | None = None,
) -> TensorDict:
    """Return the joint loss of the VAE and its inverse model, on windows of consecutive frames.

    With z sampled from N(mu, sigma^2), once per frame, the terms are

    - ``reconstruction``: squared error, summed over the values of a frame, mean over frames.
      With a mean over pixels, a small object would count so little that the KL term would switch
      off the dimensions that encode it.
    - ``kl``: KL(N(mu, sigma^2) || N(0, 1)), summed over dimensions, mean over frames.
    - ``inverse``: ``1/2 ||a_hat_t - a_t||^2``, with a_hat_t predicted from z_t and z_t+1, mean over
      the ``K - 1`` transitions of the windows whose actions are known; 0 if there are none.

    Args:
        vae: Network to train.
        windows: Reads ``pixels`` uint8 ``[*B, K, H, W, 3]``, ``action`` ``[*B, K, A]``, in which
            action t leads from frame t to t + 1 (the last one is ignored), and optionally
            ``action_known`` bool ``[*B]``, by default true: the actions of somebody else's
            demonstration are unknown.
        config: Weights of the terms. In ``loss_reconstruction``, the further weight of a pixel's
            error is times its largest difference to ``vae.mean_frame``, so that small objects count
            beside what varies little everywhere.
        generator: Source of the sampling noise; None: torch's default generator.

    Returns:
        The terms ``[]``: detached and without weights, for logging, and weighted as ``loss_*``,
        which add up to the objective.

    Raises:
        ValueError: If a window has fewer than 2 frames, an entry is missing, or actions have
            another shape.

    Examples:
        >>> frames = torch.zeros(3, 4, 32, 64, 3, dtype=torch.uint8)
        >>> windows = TensorDict({"pixels": frames, "action": torch.zeros(3, 4, 4)}, [3, 4])
        >>> loss = vae_inverse_loss(VAE(), windows, VAEConfig())
        >>> sorted(key for key in loss.keys() if key.startswith("loss_"))
        ['loss_inverse', 'loss_kl', 'loss_reconstruction']
    """
    pixels, action = _entries("vae_inverse_loss", windows, ["pixels", "action"])
    if pixels.ndim < 5 or pixels.shape[-4] < 2:
        raise ValueError(f"windows need at least 2 frames, got pixels {tuple(pixels.shape)}")
    mu, log_variance = vae.encode(pixels)
    noise = torch.randn(mu.shape, generator=generator).to(mu.device)
    z = mu + noise * (log_variance / 2).exp()
    frames = pixels / 255
    error = (vae.decode(z) - frames).square()
    # Consecutive latents differ too little for the precision of autocast.
    with torch.autocast(z.device.type, enabled=False):
        predicted = vae.inverse(z[..., :-1, :], z[..., 1:, :])
    if action.shape != (*pixels.shape[:-3], predicted.shape[-1]):
        raise ValueError(
            f"action must be {[*pixels.shape[:-3], predicted.shape[-1]]} for these pixels and "
            f"this VAE, got {[*action.shape]}"
        )
    known = windows.get("action_known", None)
    if known is None:
        known = torch.ones(pixels.shape[:-4], dtype=torch.bool, device=pixels.device)
    if known.shape != pixels.shape[:-4]:
        raise ValueError(f"action_known must be {[*pixels.shape[:-4]]}, got {[*known.shape]}")
    error_of_action = torch.where(known[..., None, None], predicted - action[..., :-1, :], 0.0)
    squared = error_of_action.square().sum(-1).mean(-1)
    difference = (frames - vae.mean_frame).abs().amax(-1, keepdim=True)
    counted = error * (1 + config.foreground_weight * difference)
    kl = (mu.square() + log_variance.exp() - 1 - log_variance).sum(-1).mean() / 2
    inverse = squared.sum() / known.sum().clamp_min(1) / 2
    terms = {
        "loss_reconstruction": config.reconstruction_weight * counted.sum((-3, -2, -1)).mean(),
        "loss_kl": config.kl_weight * kl,
        "loss_inverse": config.inverse_weight * inverse,
        "reconstruction": error.detach().sum((-3, -2, -1)).mean(),
        "kl": kl.detach(),
        "inverse": inverse.detach(),
    }
    return TensorDict(terms, [])


def action_inference_loss(inverse: InverseModel, batch: TensorDictBase) -> TensorDict:
    """Return the squared error of the inverse model, summed over an action, ``loss_inverse``.

    Reads ``window`` ``[*B, 8 * latent_size]`` and ``action`` ``[*B, action_size]``.
    """
    window, action = _entries("action_inference_loss", batch, ["window", "action"])
    # Without the model's clamp, beyond which there would be no gradient.
    error = (inverse.network(window) - action).square().sum(-1).mean()
    return TensorDict({"loss_inverse": error}, [])


def sequence_reconstruction_loss(lae: SequenceAutoencoder, batch: TensorDictBase) -> TensorDict:
    """Return the masked mean squared error of the sequence autoencoder, ``loss_reconstruction``.

    Each sequence is embedded, reconstructed in reverse order and compared with its valid latents,
    those before ``length``. All valid steps of the batch have equal weight.

    Args:
        lae: Network to train.
        batch: Reads ``latent`` ``[*B, T, latent_size]`` and ``length`` int64 ``[*B]``.

    Raises:
        ValueError: If an entry is missing.

    Examples:
        >>> length = torch.tensor([51, 9])
        >>> batch = TensorDict({"latent": torch.randn(2, 51, 64), "length": length}, [2])
        >>> loss = sequence_reconstruction_loss(SequenceAutoencoder(), batch)
        >>> loss["loss_reconstruction"].shape
        torch.Size([])
    """
    latent, length = _entries("sequence_reconstruction_loss", batch, ["latent", "length"])
    n_steps = int(length.max())
    reconstructed = lae.decode(lae.encode(latent, length), n_steps)
    back = length.unsqueeze(-1) - 1 - torch.arange(n_steps, device=length.device)
    valid = (back >= 0).unsqueeze(-1)
    target = latent.gather(-2, back.clamp_min(0).unsqueeze(-1).expand_as(reconstructed))
    error = torch.where(valid, reconstructed - target, 0.0).square().sum()
    return TensorDict({"loss_reconstruction": error / (valid.sum() * latent.shape[-1])}, [])


def distillation_loss(actor: TensorDictModuleBase, batch: TensorDictBase) -> Tensor:
    """Return the negative log-likelihood of the teachers' actions, ``[]``.

    It is ``-log N(teacher_action; loc, scale^2)``, summed over action components and tasks, mean
    over ``B`` (Rusu et al., 2016, Eq. 1, for Gaussians).

    Args:
        actor: Policy that writes ``loc`` and ``scale``.
        batch: Reads the ``in_keys`` of the policy, ``teacher_action`` ``[T, B, action_dim]`` and,
            if present, ``priority_weight`` ``[T, B]``, a factor of each state's loss.

    Raises:
        ValueError: If an entry is missing or has the wrong shape, or the policy writes no
            distribution.
    """
    keys = [*actor.in_keys, "teacher_action"]
    *_, teacher_action = _entries("distillation_loss", batch, keys)
    policy = actor(batch.select(*actor.in_keys))
    loc, scale = policy.get("loc", None), policy.get("scale", None)
    if loc is None or scale is None:
        raise missing_key("distillation_loss, from its actor,", policy, ["loc", "scale"])
    if teacher_action.shape != loc.shape:
        raise ValueError(
            f"'teacher_action' must be {[*loc.shape]}, as the policy's 'loc' is, got "
            f"{[*teacher_action.shape]}"
        )
    shown, variance = teacher_action.detach(), scale.square()
    loss = gaussian_nll_loss(loc, shown, variance, full=True, reduction="none").sum(-1)
    weights = batch.get("priority_weight", None)
    if weights is not None:
        if weights.shape != loss.shape:
            raise ValueError(
                f"'priority_weight' must be one weight a state, {[*loss.shape]}, got "
                f"{[*weights.shape]}"
            )
        loss = loss * weights
    return loss.mean(-1).sum()
