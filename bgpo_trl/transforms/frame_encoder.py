"""Encoding of frames as latents (paper, Sec. III-A)."""

from __future__ import annotations

from itertools import chain

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite
from torchrl.envs import Transform

from bgpo_trl.modules.frame_network import FrameNetwork
from bgpo_trl.transforms._episode import starting, unbounded


class FrameEncoder(Transform):
    """Latents of all frames by a frozen encoder, ``z = f_V(s)`` (Alg. 1), without gradient.

    1. At reset, only the frames of the rows that are reset are encoded: with one environment per
       seed, episodes end one at a time, and the encoder is the most expensive part.
    2. At every step, the frames of the rows that are stepped are encoded (all of them, without a
       ``_step``), including the last ones of an episode. The other rows keep their latents.
    3. With ``del_keys``, the frames are then dropped, so that no replay buffer or rollout stores
       them.

    It also works in a replay buffer or on any TensorDict with frames. Reads ``in_key``, uint8
    ``[*B, H, W, 3]``; writes ``out_key``, float32 ``[*B, 64]``.

    Args:
        network: The encoder, such as the `VAE`; only its ``latent`` is called.
        in_key: Key of the frames.
        out_key: Key of the latents.
        del_keys: Drop the frames once they are encoded.

    Raises:
        ValueError: If frames are missing.

    Examples:
        >>> from tensordict import TensorDict
        >>> from bgpo_trl.modules.vae import VAE
        >>> encoder = FrameEncoder(VAE(), del_keys=True)
        >>> frames = torch.zeros(5, 32, 64, 3, dtype=torch.uint8)
        >>> data = encoder(TensorDict({"pixels": frames}, batch_size=[5]))
        >>> print({key: value.shape for key, value in data.items()})
        {'latent': torch.Size([5, 64])}
    """

    def __init__(
        self,
        network: FrameNetwork,
        in_key: NestedKey = "pixels",
        out_key: NestedKey = "latent",
        *,
        del_keys: bool = False,
    ) -> None:
        super().__init__(in_keys=[in_key], out_keys=[out_key])
        self.in_key, self.out_key = in_key, out_key
        self.network = network
        self.del_keys = del_keys
        self._latest: Tensor | None = None

    @torch.no_grad()
    def _apply_transform(self, obs: Tensor) -> Tensor:
        # Simulations are on the CPU, even if the encoder is not.
        stored = chain(self.network.parameters(), self.network.buffers())
        device = next((values.device for values in stored), obs.device)
        return self.network.latent(obs.to(device)).to(obs.device)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Encode the frames of any TensorDict."""
        return self._encode(tensordict, None, None)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self.forward(next_tensordict)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        stepped = tensordict.get("_step", None)
        rows = None if stepped is None else stepped.reshape(tensordict.batch_size)
        before = None if rows is None else tensordict.get(self.out_key, None)
        # TorchRL does not hand a reset the observation before it.
        self._latest = self._encode(next_tensordict, rows, before).get(self.out_key)
        return next_tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        rows = starting(tensordict)
        rows = None if rows.all() else rows
        self._latest = self._encode(tensordict_reset, rows, self._latest).get(self.out_key)
        return tensordict_reset

    def _encode(
        self, tensordict: TensorDictBase, rows: Tensor | None, before: Tensor | None
    ) -> TensorDictBase:
        """Encode some rows; the others keep their latents, which later transforms may read."""
        frames = tensordict.get(self.in_key, None)
        if frames is None:
            raise self._no_frames()
        if rows is None or before is None or before.shape[:-1] != rows.shape:
            latent = self._apply_transform(frames)
        else:
            latent = before.clone()
            latent[rows] = self._apply_transform(frames[rows])
        tensordict.set(self.out_key, latent)
        if self.del_keys:
            tensordict.pop(self.in_key)
        return tensordict

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the latents and, with ``del_keys``, drop the frames."""
        if self.in_key not in observation_spec.keys(True, True):
            raise self._no_frames()
        frame = observation_spec[self.in_key].zero()[(0,) * observation_spec.ndim]
        latent = self._apply_transform(frame)
        size, dtype = latent.shape[-1], latent.dtype
        observation_spec[self.out_key] = unbounded(observation_spec, size, dtype=dtype)
        if self.del_keys:
            del observation_spec[self.in_key]
        return observation_spec

    def _no_frames(self) -> ValueError:
        return ValueError(
            f"FrameEncoder found no {self.in_key!r} in the environment: observe pixels, or give "
            "the key of its frames"
        )
