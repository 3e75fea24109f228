"""The intrinsic reward for matching the demonstrated behavior (paper, Sec. III-C)."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded

from bgpo_trl.modules.sequence_autoencoder import SequenceAutoencoder
from bgpo_trl.transforms._episode import EpisodeTransform, ending


def matching_reward(behavior: Tensor, phi: Tensor) -> Tensor:
    """Return the intrinsic reward ``exp(-||b - phi_g||)`` (Eq. 7) of embeddings ``[*B, d]``."""
    return torch.exp(-torch.linalg.vector_norm(behavior - phi, dim=-1))


class BehaviorMatchingReward(EpisodeTransform):
    """Intrinsic reward at the end of an episode for matching its behavior ``b`` (Eq. 7).

    1. At reset, the encoder of the LSTM autoencoder reads the first latent ``z_0``, from a zero
       state.
    2. At every step it reads the next latent of the rows that are stepped. Its state is part of the
       TensorDict, so no trajectory is stored: after the last latent, ``lae_h`` is ``phi_g``, the
       embedding of the trajectory.
    3. The intrinsic reward is ``exp(-||b - phi_g||)`` on the step that ends the episode, by success
       or by time-out, and 0 on all others. The reward becomes extrinsic + beta * intrinsic.

    Put it after ``StepCounter`` and before ``RewardSum``. TorchRL's ``NoopResetEnv`` and
    ``TargetReturn``, which expect one reward, come before it.

    Reads ``latent`` float32 ``[*B, 64]``, ``behavior`` float32 ``[*B, 32]``, ``reward`` ``[*B, 1]``
    and ``done``; writes ``lae_h`` and ``lae_c`` float32 ``[*B, 32]``, ``extrinsic_reward``,
    ``intrinsic_reward`` and ``reward`` ``[*B, 1]``, in the dtype of ``reward``.

    Args:
        lae: The autoencoder; called without gradient.
        beta: Weight of the intrinsic reward, which is measured even if 0.

    Raises:
        ValueError: If beta is negative, latents, behaviors or rewards are missing or of another
            size than the encoder's, rewards are integers, or a last latent is NaN or Inf.

    Examples:
        >>> from types import SimpleNamespace
        >>> from torchrl.envs import Compose, PendulumEnv, RenameTransform, StepCounter
        >>> from torchrl.envs import TransformedEnv, UnsqueezeTransform
        >>> from bgpo_trl.transforms import DemonstrationSource, TaskSchedule
        >>> bank = SimpleNamespace(embedding=torch.rand(4, 32), task=torch.zeros(4).long())
        >>> env = TransformedEnv(
        ...     PendulumEnv(),
        ...     Compose(
        ...         UnsqueezeTransform(-1, in_keys=["th"], out_keys=["latent"]),
        ...         StepCounter(50),
        ...         DemonstrationSource(bank, TaskSchedule(starts=(0,))),
        ...         RenameTransform(["demo_embedding"], ["behavior"], create_copy=True),
        ...         BehaviorMatchingReward(SequenceAutoencoder(latent_size=1), beta=0.1),
        ...     ),
        ... )
        >>> last = env.rollout(50)[-1]["next"]
        >>> last["reward"].allclose(last["extrinsic_reward"] + 0.1 * last["intrinsic_reward"])
        True
    """

    reads = ("latent", "behavior", "reward")
    writes = ("lae_h", "lae_c", "extrinsic_reward", "intrinsic_reward")
    changes_reward = True
    acts_at_end = True

    def __init__(self, lae: SequenceAutoencoder, beta: float = 0.1) -> None:
        if not 0 <= beta < math.inf:
            raise ValueError(f"beta must not be negative, got {beta}")
        super().__init__()
        self.lae = lae
        self.beta = beta

    @torch.no_grad()
    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        # The state has the size of phi_g, and so of the behavior.
        zeros = torch.zeros_like(tensordict_reset["behavior"])
        self._read(tensordict_reset["latent"], zeros, zeros, tensordict_reset)
        return tensordict_reset

    @torch.no_grad()
    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        h, c = tensordict.get("lae_h"), tensordict.get("lae_c")
        phi = self._read(next_tensordict.get("latent"), h, c, next_tensordict)
        stepped = tensordict.get("_step", None)
        if stepped is not None:
            rows = stepped.reshape(*phi.shape[:-1], 1)
            for key, before in (("lae_h", h), ("lae_c", c)):
                next_tensordict.set(key, torch.where(rows, next_tensordict.get(key), before))
        extrinsic = next_tensordict.get("reward")
        if not extrinsic.is_floating_point():  # in which the intrinsic reward would be 0
            raise ValueError(f"rewards are {extrinsic.dtype}: put DTypeCastTransform before this")
        intrinsic = torch.zeros_like(extrinsic)
        ended = ending(tensordict, next_tensordict)
        if ended.any():
            bonus = torch.where(ended, matching_reward(tensordict.get("behavior"), phi), 0)
            if not bonus.isfinite().all():
                raise ValueError(
                    "the latent at the end of an episode is NaN or Inf, as in an environment that "
                    "resets itself (auto_reset=True): let TorchRL reset it"
                )
            intrinsic = bonus.unsqueeze(-1).to(extrinsic.dtype)
        next_tensordict.set("extrinsic_reward", extrinsic)
        next_tensordict.set("intrinsic_reward", intrinsic)
        return next_tensordict.set("reward", extrinsic + self.beta * intrinsic)

    def _read(self, z: Tensor, h: Tensor, c: Tensor, into: TensorDictBase) -> Tensor:
        # Simulations are on the CPU, even if the encoder is not.
        device = next(self.lae.parameters()).device
        if z.device == device:
            h, c = self.lae.step(z, h, c)
        else:
            h, c = (x.to(z.device) for x in self.lae.step(z.to(device), h.to(device), c.to(device)))
        into.set("lae_h", h).set("lae_c", c)
        return h

    def _entries(self, observation_spec: Composite) -> dict[str, TensorSpec]:
        latent = self._read_spec(observation_spec, "latent", "FrameEncoder")
        behavior = self._read_spec(observation_spec, "behavior", "BehaviorLookup")
        sizes = latent.shape[-1], behavior.shape[-1]
        if sizes != (self.lae.latent_size, self.lae.embedding_size):
            raise ValueError(
                f"latents and behaviors have sizes {sizes}, but the sequence encoder was made for "
                f"{self.lae.latent_size} and {self.lae.embedding_size}: use a pair trained together"
            )
        return {"lae_h": behavior.clone(), "lae_c": behavior.clone()}

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        """Add the parts of the reward and unbound their sum."""
        extrinsic = self._read_spec(reward_spec, "reward", "an environment with one")
        like = {"shape": extrinsic.shape, "device": extrinsic.device, "dtype": extrinsic.dtype}
        reward_spec["extrinsic_reward"] = extrinsic.clone()
        reward_spec["intrinsic_reward"] = Bounded(low=0.0, high=1.0, **like)
        reward_spec["reward"] = Unbounded(**like)
        return reward_spec
