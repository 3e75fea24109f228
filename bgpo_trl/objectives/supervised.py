"""Losses of supervised learning: the encoders (paper, Sec. III-A) and distillation."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.nn.functional import gaussian_nll_loss
from torchrl.objectives import LossModule

from bgpo_trl.errors import missing_key
from bgpo_trl.modules.inverse_model import InverseModel
from bgpo_trl.modules.sequence_autoencoder import SequenceAutoencoder
from bgpo_trl.modules.vae import VAE

__all__ = [
    "ActionInferenceLoss",
    "DistillationLoss",
    "SequenceReconstructionLoss",
    "VAEInverseLoss",
]


class NetworkLoss(LossModule):
    """Base of losses whose parameters stay in their network, and whose entries have fixed names.

    Args:
        in_keys: Entries read.
        out_keys: Entries written.
    """

    def __init__(self, in_keys: Sequence[NestedKey], out_keys: Sequence[str]) -> None:
        super().__init__()
        self.in_keys = list(in_keys)  # pyright: ignore[reportAttributeAccessIssue] any nested keys
        self.out_keys = list(out_keys)

    @property
    def functional(self) -> bool:
        """False, since the parameters stay in the network."""
        return False

    def inputs(self, tensordict: TensorDictBase) -> list[Tensor]:
        """Return the entries of ``in_keys``; raise ``ValueError`` if one is missing."""
        if any(tensordict.get(key, None) is None for key in self.in_keys):
            raise missing_key(type(self).__name__, tensordict, self.in_keys)
        return [tensordict.get(key) for key in self.in_keys]


class VAEInverseLoss(NetworkLoss):
    """Joint loss of the VAE and its inverse model, on windows of consecutive frames ``[*B, K]``.

    With z sampled from N(mu, sigma^2), once per frame, the terms are

    - ``reconstruction``: squared error, summed over the values of a frame, mean over frames.
      With a mean over pixels, a small object would count so little that the KL term would switch
      off the dimensions that encode it.
    - ``kl``: KL(N(mu, sigma^2) || N(0, 1)), summed over dimensions, mean over frames.
    - ``inverse``: ``1/2 ||a_hat_t - a_t||^2``, with a_hat_t predicted from z_t and z_t+1, mean over
      the ``K - 1`` transitions of the windows whose actions are known; 0 if there are none.

    Reads ``pixels`` uint8 ``[*B, K, H, W, 3]``, ``action`` ``[*B, K, A]``, in which action t
    leads from frame t to t + 1 (the last one is ignored), and optionally ``action_known`` bool
    ``[*B]``, by default true: the actions of somebody else's demonstration are unknown. Writes the
    terms ``[]``: detached, for logging, and weighted as ``loss_*``, which add up to the
    objective.

    Args:
        vae: Network to train.
        reconstruction_weight: Weight of ``reconstruction``.
        kl_weight: Weight of ``kl``.
        inverse_weight: Weight of ``inverse``.
        generator: Source of the sampling noise; None: torch's default generator.

    Raises:
        ValueError: From ``forward``, if a window has fewer than 2 frames, an entry is missing, or
            actions have another shape.

    Examples:
        >>> loss = VAEInverseLoss(VAE(), generator=torch.Generator().manual_seed(0))
        >>> frames = torch.zeros(3, 4, 32, 64, 3, dtype=torch.uint8)
        >>> windows = TensorDict({"pixels": frames, "action": torch.zeros(3, 4, 4)}, [3, 4])
        >>> sorted(key for key in loss(windows).keys() if key.startswith("loss_"))
        ['loss_inverse', 'loss_kl', 'loss_reconstruction']
    """

    def __init__(
        self,
        vae: VAE,
        *,
        reconstruction_weight: float = 1.0,
        kl_weight: float = 0.01,
        inverse_weight: float = 1.0,
        generator: torch.Generator | None = None,
    ) -> None:
        terms = ["reconstruction", "kl", "inverse"]
        super().__init__(["pixels", "action"], [*(f"loss_{name}" for name in terms), *terms])
        self.vae = vae
        self.weights = {
            "reconstruction": reconstruction_weight,
            "kl": kl_weight,
            "inverse": inverse_weight,
        }
        self.generator = generator

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Return the terms for a batch of windows."""
        pixels, action = self.inputs(tensordict)
        if pixels.ndim < 5 or pixels.shape[-4] < 2:
            raise ValueError(f"windows need at least 2 frames, got pixels {tuple(pixels.shape)}")
        mu, log_variance = self.vae.encode(pixels)
        noise = torch.randn(mu.shape, generator=self.generator).to(mu.device)
        z = mu + noise * (log_variance / 2).exp()
        residual = self.vae.decode(z) - pixels / 255
        # Consecutive latents differ too little for the precision of autocast.
        with torch.autocast(z.device.type, enabled=False):
            predicted = self.vae.inverse(z[..., :-1, :], z[..., 1:, :])
        if action.shape != (*pixels.shape[:-3], predicted.shape[-1]):
            raise ValueError(
                f"action must be {[*pixels.shape[:-3], predicted.shape[-1]]} for these pixels and "
                f"this VAE, got {[*action.shape]}"
            )
        known = tensordict.get("action_known", None)
        if known is None:
            known = torch.ones(pixels.shape[:-4], dtype=torch.bool, device=pixels.device)
        squared = (predicted - action[..., :-1, :]).square().sum(-1).mean(-1)
        terms = {
            "reconstruction": residual.square().sum((-3, -2, -1)).mean(),
            "kl": (mu.square() + log_variance.exp() - 1 - log_variance).sum(-1).mean() / 2,
            "inverse": (squared * known).sum() / known.sum().clamp_min(1) / 2,
        }
        weighted = {f"loss_{name}": self.weights[name] * term for name, term in terms.items()}
        return TensorDict({**weighted, **{name: term.detach() for name, term in terms.items()}}, [])


class ActionInferenceLoss(NetworkLoss):
    """Squared error of the inverse model, summed over an action.

    Reads ``window`` ``[*B, 8 * latent_size]`` and ``action`` ``[*B, action_size]``; writes
    ``loss_inverse`` ``[]``, a mean. From ``forward``, a missing entry raises ``ValueError``.

    Args:
        inverse: Network to train.
    """

    def __init__(self, inverse: InverseModel) -> None:
        super().__init__(["window", "action"], ["loss_inverse"])
        self.inverse = inverse

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Return the loss for a batch of windows."""
        window, action = self.inputs(tensordict)
        # Without the clamp of `infer`, beyond which there would be no gradient.
        error = (self.inverse.network(window) - action).square().sum(-1).mean()
        return TensorDict({"loss_inverse": error}, [])


class SequenceReconstructionLoss(NetworkLoss):
    """Masked mean squared error of the sequence autoencoder (paper, Sec. III-A).

    Each sequence is embedded, reconstructed in reverse order and compared with its valid latents,
    those before ``length``. All valid steps of the batch have equal weight.

    Reads ``latent`` ``[*B, T, latent_size]`` and ``length`` int64 ``[*B]``; writes
    ``loss_reconstruction`` ``[]``. From ``forward``, a missing entry raises ``ValueError``.

    Args:
        lae: Network to train.

    Examples:
        >>> loss = SequenceReconstructionLoss(SequenceAutoencoder())
        >>> length = torch.tensor([51, 9])
        >>> data = TensorDict({"latent": torch.randn(2, 51, 64), "length": length}, [2])
        >>> loss(data)["loss_reconstruction"].shape
        torch.Size([])
    """

    def __init__(self, lae: SequenceAutoencoder) -> None:
        super().__init__(["latent", "length"], ["loss_reconstruction"])
        self.lae = lae

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Return the loss for a batch of sequences."""
        latent, length = self.inputs(tensordict)
        n_steps = int(length.max())
        reconstructed = self.lae.decode(self.lae.encode(latent, length), n_steps)
        back = length.unsqueeze(-1) - 1 - torch.arange(n_steps, device=length.device)
        valid = (back >= 0).unsqueeze(-1)
        target = latent.gather(-2, back.clamp_min(0).unsqueeze(-1).expand_as(reconstructed))
        error = torch.where(valid, reconstructed - target, 0.0).square().sum()
        return TensorDict(
            {"loss_reconstruction": error / (valid.sum() * latent.shape[-1])},
            [],
        )


class DistillationLoss(NetworkLoss):
    """Negative log-likelihood of the teachers' actions (Rusu et al., 2016, Eq. 1, for Gaussians).

    Reads the ``in_keys`` of the policy, ``teacher_action`` ``[T, B, action_dim]`` and, if present,
    ``priority_weight`` ``[T, B]``, a factor of each state's loss; writes ``loss_distillation``
    ``[]``: ``-log N(teacher_action; loc, scale^2)``, summed over action components and tasks, mean
    over ``B``.

    Args:
        actor_network: Policy that writes ``loc`` and ``scale``.

    Raises:
        ValueError: From ``forward``, if an entry is missing or has the wrong shape, or the policy
            writes no distribution.
    """

    def __init__(self, actor_network: TensorDictModuleBase) -> None:
        super().__init__([*actor_network.in_keys, "teacher_action"], ["loss_distillation"])
        self.actor_network = actor_network

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Return the loss for states and teachers' actions ``[T, B]``."""
        *_, teacher_action = self.inputs(tensordict)
        policy = self.actor_network(tensordict.select(*self.actor_network.in_keys))
        loc, scale = policy.get("loc", None), policy.get("scale", None)
        if loc is None or scale is None:
            raise missing_key("DistillationLoss, from its actor,", policy, ["loc", "scale"])
        if teacher_action.shape != loc.shape:
            raise ValueError(
                f"'teacher_action' must be {[*loc.shape]}, as the policy's 'loc' is, got "
                f"{[*teacher_action.shape]}"
            )
        nll = gaussian_nll_loss(
            loc, teacher_action.detach(), scale.square(), full=True, reduction="none"
        )
        loss, weights = nll.sum(-1), tensordict.get("priority_weight", None)
        if weights is not None:
            if weights.shape != loss.shape:
                raise ValueError(
                    f"'priority_weight' must be one weight a state, {[*loss.shape]}, got "
                    f"{[*weights.shape]}"
                )
            loss = loss * weights
        return TensorDict({"loss_distillation": loss.mean(-1).sum()})
