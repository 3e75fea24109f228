"""The intrinsic reward for behaving as demonstrated (paper, section III-C)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded

from bgpo_trl.modules.sequence_autoencoder import SequenceAutoencoder
from bgpo_trl.transforms._episode import EpisodeTransform, ending


class BehaviorMatchingReward(EpisodeTransform):
    """Rewards an episode, at its end, for how well it matches the behavior it was to show (Eq. 7).

    1. At reset, the encoder of the LSTM autoencoder reads the first latent `z_0`, from a state of
       zeros.
    2. At every step it reads the next latent. Its state travels in the TensorDict, so that no
       trajectory has to be kept: after the last one, `lae_h` is `phi_g`, the embedding of the
       generated trajectory.
    3. On the step with which the episode ends, by success or by time-out, the intrinsic reward is
       `exp(-||b - phi_g||)`; on all others it is 0.
    4. The reward becomes extrinsic + beta * intrinsic; the two are also kept by themselves.

    It comes after `StepCounter`, which says when an episode times out, and before `RewardSum`,
    which sums up the three rewards.

    Reads `latent` float32 `[*B, 64]`, `behavior` float32 `[*B, 32]`, `reward` `[*B, 1]`, `done`;
    writes `lae_h` and `lae_c` float32 `[*B, 32]`, `extrinsic_reward` and `intrinsic_reward`
    `[*B, 1]`, and `reward` anew. Rewards keep the dtype of `reward`.

    Args:
        lae: the autoencoder, with `step(z [..., 64], h [..., 32], c [..., 32]) -> (h, c)`. No
            gradient is recorded.
        beta: weight of the intrinsic reward. With 0 it is still measured (the ablation without it).
        in_keys: names of latent, behavior and reward.
        out_keys: names for the two halves of the LSTM's state and the two parts of the reward.
        done_key: the `done` that ends an episode.

    Raises:
        ValueError: if beta is negative, or latents, behaviors or rewards are not there, or of other
            sizes than the encoder's.

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

    pays = True

    def __init__(
        self,
        lae: SequenceAutoencoder,
        beta: float = 0.1,
        *,
        in_keys: Sequence[NestedKey] = ("latent", "behavior", "reward"),
        out_keys: Sequence[NestedKey] = ("lae_h", "lae_c", "extrinsic_reward", "intrinsic_reward"),
        done_key: NestedKey = "done",
    ) -> None:
        if not 0 <= beta < math.inf:
            raise ValueError(f"beta must not be negative, got {beta}")
        super().__init__(in_keys, out_keys, done_key)
        self.lae = lae
        self.beta = beta

    @torch.no_grad()
    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        # phi_g is compared with the behavior, so they are of one size.
        zeros = torch.zeros_like(tensordict_reset[self.in_keys[1]])
        self._read(tensordict_reset[self.in_keys[0]], zeros, zeros, tensordict_reset)
        return tensordict_reset

    @torch.no_grad()
    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        latent_key, behavior_key, reward_key = self.in_keys
        h_key, c_key, extrinsic_key, intrinsic_key = self.out_keys
        h, c = tensordict[h_key], tensordict[c_key]
        phi = self._read(next_tensordict[latent_key], h, c, next_tensordict)
        error = torch.linalg.vector_norm(tensordict[behavior_key] - phi, dim=-1)
        extrinsic = next_tensordict[reward_key]
        ended = ending(tensordict, next_tensordict, self.done_key)
        intrinsic = torch.where(ended, torch.exp(-error), 0).unsqueeze(-1).to(extrinsic.dtype)
        next_tensordict.set(extrinsic_key, extrinsic)
        next_tensordict.set(intrinsic_key, intrinsic)
        return next_tensordict.set(reward_key, extrinsic + self.beta * intrinsic)

    def _read(self, z: Tensor, h: Tensor, c: Tensor, into: TensorDictBase) -> Tensor:
        h, c = self.lae.step(z, h, c)
        into.set(self.out_keys[0], h).set(self.out_keys[1], c)
        return h

    def _entries(self, observation_spec: Composite) -> dict[NestedKey, TensorSpec]:
        latent = self._read_spec(observation_spec, self.in_keys[0], "FrameEncoder")
        behavior = self._read_spec(observation_spec, self.in_keys[1], "BehaviorLookup")
        sizes = latent.shape[-1], behavior.shape[-1]
        if sizes != (self.lae.latent_size, self.lae.embedding_size):
            raise ValueError(
                f"latents and behaviors have sizes {sizes}, but the sequence encoder was made for "
                f"{self.lae.latent_size} and {self.lae.embedding_size}: use those trained together"
            )
        return {key: behavior.clone() for key in self.out_keys[:2]}

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        """Add the parts of the reward; the sum can be larger than what the environment pays."""
        reward_key = self.in_keys[2]
        if reward_key not in reward_spec.keys(True, True):
            raise ValueError(f"the environment has no reward {reward_key!r}: name it in in_keys")
        extrinsic = reward_spec[reward_key]
        like = {"shape": extrinsic.shape, "device": extrinsic.device, "dtype": extrinsic.dtype}
        reward_spec[self.out_keys[2]] = extrinsic.clone()
        reward_spec[self.out_keys[3]] = Bounded(low=0.0, high=1.0, **like)
        reward_spec[reward_key] = Unbounded(**like)
        return reward_spec
