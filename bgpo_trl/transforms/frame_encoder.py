"""Encoding of frames as latents (paper, Sec. III-A)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite
from torchrl.envs import Transform

from bgpo_trl.modules.vae import VAE
from bgpo_trl.transforms._episode import starting, unbounded


class FrameEncoder(Transform):
    """Latents of all frames by a frozen encoder, ``z = f_V(s)`` (Alg. 1), without gradient.

    1. At reset, only the frames of the rows that are reset are encoded: with one environment per
       seed, episodes end one at a time, and the encoder is the most expensive part.
    2. At every step, the frames of the rows that are stepped are encoded (all of them, without a
       ``_step``), including the last ones of an episode. The other rows keep their latents.
    3. With ``del_keys``, the frames are then dropped, so that no replay buffer or rollout stores
       them.

    It also works in a replay buffer or on any TensorDict with frames. Reads the ``in_keys``, uint8
    ``[*B, H, W, 3]``; writes the ``out_keys``, float32 ``[*B, 64]``.

    Args:
        vae: The encoder; only its ``latent`` is called.
        in_keys: Keys of the frames.
        out_keys: Keys of the latents, one for each of ``in_keys``.
        del_keys: Drop the frames once they are encoded.

    Raises:
        ValueError: If the numbers of ``in_keys`` and ``out_keys`` differ, or frames are missing.

    Examples:
        >>> from tensordict import TensorDict
        >>> encoder = FrameEncoder(VAE(), del_keys=True)
        >>> frames = torch.zeros(5, 32, 64, 3, dtype=torch.uint8)
        >>> data = encoder(TensorDict({"pixels": frames}, batch_size=[5]))
        >>> print({key: value.shape for key, value in data.items()})
        {'latent': torch.Size([5, 64])}
    """

    def __init__(
        self,
        vae: VAE,
        in_keys: Sequence[NestedKey] = ("pixels",),
        out_keys: Sequence[NestedKey] = ("latent",),
        *,
        del_keys: bool = False,
    ) -> None:
        if len(in_keys) != len(out_keys):
            raise ValueError(
                f"FrameEncoder needs one of out_keys for each of in_keys, got {len(out_keys)} for "
                f"{len(in_keys)}"
            )
        super().__init__(in_keys=list(in_keys), out_keys=list(out_keys))
        self.vae = vae
        self.del_keys = del_keys
        self._latest: list[Tensor | None] = [None] * len(self.in_keys)

    @torch.no_grad()
    def _apply_transform(self, obs: Tensor) -> Tensor:
        # Simulations are on the CPU, even if the encoder is not.
        device = next((weights.device for weights in self.vae.parameters()), obs.device)
        return self.vae.latent(obs.to(device)).to(obs.device)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Encode the frames of any TensorDict."""
        for in_key, out_key in zip(self.in_keys, self.out_keys, strict=True):
            frames = tensordict.get(in_key, None)
            if frames is None:
                raise _no_frames(in_key)
            tensordict.set(out_key, self._apply_transform(frames))
        return self._drop(tensordict)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self.forward(next_tensordict)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        stepped = tensordict.get("_step", None)
        if stepped is None:
            return self._encode(next_tensordict, None, ())
        before = [tensordict.get(key, None) for key in self.out_keys]
        return self._encode(next_tensordict, stepped.reshape(tensordict.batch_size), before)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        rows = starting(tensordict)
        return self._encode(tensordict_reset, None if rows.all() else rows, self._latest)

    def _encode(
        self, tensordict: TensorDictBase, rows: Tensor | None, before: Sequence[Tensor | None]
    ) -> TensorDictBase:
        """Encode some rows; the others keep their latents, which later transforms may read."""
        old = [latent for latent in before if latent is not None]
        if rows is None or [latent.shape[:-1] for latent in old] != [rows.shape] * len(before):
            self.forward(tensordict)
        else:
            for in_key, out_key, latent in zip(self.in_keys, self.out_keys, old, strict=True):
                latent = latent.clone()
                latent[rows] = self._apply_transform(tensordict[in_key][rows])
                tensordict.set(out_key, latent)
            self._drop(tensordict)
        # TorchRL does not hand a reset the observation before it.
        self._latest = [tensordict.get(key) for key in self.out_keys]
        return tensordict

    def _drop(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self.del_keys:
            for key in self.in_keys:
                tensordict.pop(key)
        return tensordict

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the latents and, with ``del_keys``, drop the frames."""
        for in_key, out_key in zip(self.in_keys, self.out_keys, strict=True):
            if in_key not in observation_spec.keys(True, True):
                raise _no_frames(in_key)
            batch_dims = observation_spec.ndim
            frame = observation_spec[in_key].zero()[(0,) * batch_dims]
            latent = self._apply_transform(frame)
            observation_spec[out_key] = unbounded(
                observation_spec, latent.shape[-1], dtype=latent.dtype
            )
            if self.del_keys:
                del observation_spec[in_key]
        return observation_spec


def _no_frames(key: NestedKey) -> ValueError:
    return ValueError(
        f"FrameEncoder found no {key!r} in the environment: observe pixels, or give the key of its "
        "frames in in_keys"
    )
