"""What the transforms share that write at the start of an episode and act at its end."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, cast

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.utils import unravel_key
from torch import Tensor, nn
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import Compose, EnvBase, RewardSum, StepCounter, Transform, TransformedEnv

from bgpo_trl.errors import missing_key


def starting(tensordict: TensorDictBase, done_key: NestedKey = "done") -> Tensor:
    """Rows whose episode starts with this reset, bool `[*B]`: all without a `_reset` entry."""
    reset_key = "_reset" if isinstance(done_key, str) else (*done_key[:-1], "_reset")
    reset = tensordict.get(reset_key, None)
    if reset is None:
        return torch.ones(tensordict.batch_size, dtype=torch.bool, device=tensordict.device)
    return _one_a_row(reset, tensordict)


def ending(
    tensordict: TensorDictBase, next_tensordict: TensorDictBase, done_key: NestedKey = "done"
) -> Tensor:
    """Rows whose episode ends with this step, bool `[*B]`.

    A row that is stepped on after its end, or skipped by a partial step, does not end again.
    """
    done = next_tensordict.get(done_key)
    was_done = tensordict.get(done_key, None)
    return _one_a_row(done if was_done is None else done & ~was_done, next_tensordict)


def _one_a_row(mask: Tensor, tensordict: TensorDictBase) -> Tensor:
    ndim = tensordict.batch_dims
    return mask.flatten(ndim).any(-1) if mask.ndim > ndim else mask


class EpisodeTransform(Transform):
    """Base of the transforms with entries that are set at reset and handed on from step to step.

    Such entries are part of the observation, which must keep them: the next step reads them. What
    happens at the end of an episode depends on `done`, so that a `StepCounter`, which sets it on
    time-out, must come before. One that learns then must have one: an episode that is never over
    teaches nothing. One that changes the reward must come before `RewardSum`.

    Attributes:
        learn: whether it learns at the end of an episode.
        pays: whether it changes the reward.

    Args:
        in_keys: entries read.
        out_keys: entries written.
        done_key: the entry that says where an episode has ended; its sibling `_reset` says where
            one starts.
    """

    learn: bool = False
    pays: bool = False

    def __init__(
        self, in_keys: Sequence[NestedKey], out_keys: Sequence[NestedKey], done_key: NestedKey
    ) -> None:
        super().__init__(in_keys=list(in_keys), out_keys=list(out_keys))
        self.done_key = unravel_key(done_key)

    def _entries(self, observation_spec: Composite) -> dict[NestedKey, TensorSpec]:
        """Specs of the entries handed on, given the observation so far."""
        raise NotImplementedError

    def _read_spec(self, observation_spec: Composite, key: NestedKey, source: str) -> TensorSpec:
        if key not in observation_spec.keys(True, True):
            raise ValueError(
                f"{type(self).__name__} found no {key!r}: put {source} before it, or name another "
                "entry in in_keys"
            )
        return observation_spec[key]

    def _reset_env_preprocess(self, tensordict: TensorDictBase | None) -> TensorDictBase | None:
        # Specs are only made when they are asked for. Making them now, before anything is reset,
        # lets a wrong composition be refused for what it is.
        observation_spec = cast(EnvBase, self.container).observation_spec
        self._check_limit(observation_spec)  # once more, as `learn` can have changed since
        return tensordict

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the entries of this transform."""
        self._check_order()
        for key, spec in self._entries(observation_spec).items():
            observation_spec[key] = spec
        self._check_limit(observation_spec)
        return observation_spec

    def _check_order(self) -> None:
        before, after = self._others()
        if any(isinstance(t, StepCounter) for t in after):
            raise ValueError(
                f"put StepCounter before {type(self).__name__}: it has to see where episodes end"
            )
        if self.pays and any(isinstance(t, RewardSum) for t in before):
            raise ValueError(
                f"put RewardSum after {type(self).__name__}: it has to see the reward as paid"
            )

    def _check_limit(self, observation_spec: Composite) -> None:
        if not self.learn or not isinstance(self.container, TransformedEnv):
            return
        # A StepCounter within the workers of a ParallelEnv shows only in what it counts.
        entries = [key if isinstance(key, str) else key[-1] for key in observation_spec.keys(True)]
        if "step_count" in entries or any(isinstance(t, StepCounter) for t in self._others()[0]):
            return
        raise ValueError(
            f"{type(self).__name__} learns when episodes end: put StepCounter(50) before it, or "
            "StepCounter() if the environment has a time limit of its own"
        )

    def _others(self) -> tuple[list[nn.Module], list[nn.Module]]:
        """Return the transforms before this one, those of wrapped environments too, and after."""
        env, transforms = self.container, list[nn.Module]()
        while isinstance(env, TransformedEnv):
            transforms = [*_flat(env.transform), *transforms]
            env = env.base_env
        at = transforms.index(self) if transforms else 0
        return transforms[:at], transforms[at + 1 :]


class DemonstrationLookup(EpisodeTransform):
    """Base of the transforms that look a demonstration up in a network that learns from it.

    1. At reset, what the network says of the episode's demonstration is written; it stays the same
       until the episode is over.
    2. When it is over (`done`), and with `learn=True`, the network adapts to the demonstration; the
       networks of the rows whose episode goes on are left alone.

    Args:
        network: the network, or one for each row: its `batch_size` is that of the environment, or
            (if it does not learn here) the first dimensions of it.
        learn: adapt the network. May be changed at any time; `train()` and `eval()`, which TorchRL
            calls as it likes, have no influence on it.
        in_keys: name of the demonstration's embedding.
        out_keys: entries written.
        done_key: the `done` that ends an episode.
    """

    def __init__(
        self,
        network: Any,
        *,
        learn: bool,
        in_keys: Sequence[NestedKey],
        out_keys: Sequence[NestedKey],
        done_key: NestedKey,
    ) -> None:
        super().__init__(in_keys, out_keys, done_key)
        self.network = network
        self.learn = learn

    def look_up(self, embedding: Tensor) -> tuple[Tensor, ...]:
        """Return the `out_keys` for embeddings `[*B, d]`."""
        raise NotImplementedError

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Look up the demonstrations of any TensorDict; learns nothing."""
        embedding = tensordict.get(self.in_keys[0], None)
        if embedding is None:
            raise missing_key(type(self).__name__, tensordict, self.in_keys)
        for key, value in zip(self.out_keys, self.look_up(embedding), strict=True):
            tensordict.set(key, value)
        return tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self.forward(tensordict_reset)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        for key in self.out_keys:
            next_tensordict.set(key, tensordict[key])
        if self.learn:
            ended = ending(tensordict, next_tensordict, self.done_key)
            if ended.any():
                self.network.adapt(tensordict[self.in_keys[0]], mask=ended)
        return next_tensordict

    def _demonstration_spec(self, observation_spec: Composite) -> TensorSpec:
        """Spec of the demonstration's embedding.

        Raises:
            ValueError: if there is none, or the network is to learn from an environment of another
                batch size.
        """
        demonstration = self._read_spec(observation_spec, self.in_keys[0], "DemonstrationSource")
        if self.learn and observation_spec.shape != self.network.batch_size:
            raise ValueError(
                f"{type(self.network).__name__} was made for "
                f"batch_size={tuple(self.network.batch_size)}, but the environment it is to learn "
                f"from has {tuple(observation_spec.shape)}"
            )
        return demonstration


def _flat(transform: nn.Module) -> Iterator[nn.Module]:
    if isinstance(transform, Compose):
        for part in transform.transforms:
            yield from _flat(part)
    else:
        yield transform


def unbounded(observation_spec: Composite, *shape: int, dtype: torch.dtype) -> Unbounded:
    """Spec of an entry of shape `[*B, *shape]`."""
    size = torch.Size((*observation_spec.shape, *shape))
    return Unbounded(size, device=observation_spec.device, dtype=dtype)
