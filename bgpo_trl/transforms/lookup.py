"""Task inference: from a demonstration to its behavior (paper, Sec. III-B) and its group."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec

from bgpo_trl.errors import missing_key
from bgpo_trl.modules.behavior_groups import BehaviorGroups
from bgpo_trl.seeding import generators
from bgpo_trl.transforms._episode import EpisodeTransform, ending, unbounded

__all__ = ["BehaviorLookup", "DemonstrationLookup", "GroupLookup"]


class DemonstrationLookup(EpisodeTransform):
    """Base of the transforms that look up a demonstration in a network that learns from it.

    1. At reset, the result of the lookup is written; it stays the same until the episode ends.
    2. At the end of an episode (``done``), with ``learn=True``, the network adapts to its
       demonstration. The networks of other rows do not change.

    Called on a TensorDict outside an environment, or in a replay buffer, it only looks up. A
    ``clone`` looks up in the same network, and with ``learn=True`` teaches it too.

    Args:
        network: What to look up in, for each row of the environment.
        learn: Adapt the network. May be changed at any time; independent of ``train()`` and
            ``eval()``, which TorchRL calls on all transforms. Set it to False for
            ``check_env_specs`` if episodes can end within the three steps of the check.
        in_keys: Key of the demonstration's embedding.
        out_keys: Entries written.

    Raises:
        ValueError: If the demonstration's embedding is missing, or the network is to learn from an
            environment of another batch size.
    """

    written: ClassVar[Sequence[str]]

    def __init__(
        self,
        network: Any,
        *,
        learn: bool,
        in_keys: Sequence[NestedKey] = ("demo_embedding",),
        out_keys: Sequence[NestedKey] | None = None,
    ) -> None:
        super().__init__(in_keys, self.written if out_keys is None else out_keys)
        self.network = network
        self.learn = learn

    def look_up(self, embedding: Tensor) -> tuple[Tensor, ...]:
        """Return the ``out_keys`` for embeddings ``[*B, d]``."""
        raise NotImplementedError

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Look up the demonstrations of any TensorDict, without learning."""
        embedding = tensordict.get(self.in_keys[0], None)
        if embedding is None:
            raise missing_key(type(self).__name__, tensordict, self.in_keys)
        for key, value in zip(self.out_keys, self.look_up(embedding), strict=True):
            # The network may compute in another dtype than the one that the spec announces.
            tensordict.set(key, value.to(embedding.dtype) if value.is_floating_point() else value)
        return tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self.forward(tensordict_reset)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        for key in self.out_keys:
            next_tensordict.set(key, tensordict.get(key))
        if self.learn:
            ended = ending(tensordict, next_tensordict)
            if ended.any():
                self._adapt(tensordict.get(self.in_keys[0]), ended)
        return next_tensordict

    def _adapt(self, embedding: Tensor, ended: Tensor) -> None:
        """Learn the demonstrations ``[*B, d]`` of the rows that have ended, bool ``[*B]``."""
        self.network.adapt(embedding, mask=ended)

    def _fits(self, batch_size: torch.Size) -> bool:
        """Return whether there is a network for each row of an environment."""
        return batch_size == self.network.batch_size

    def _demonstration_spec(self, observation_spec: Composite) -> TensorSpec:
        """Return the spec of the demonstration's embedding, after checking the batch size."""
        demonstration = self._read_spec(observation_spec, self.in_keys[0], "DemonstrationSource")
        if self.learn and not self._fits(observation_spec.shape):
            raise ValueError(
                f"{type(self).__name__} is to learn from an environment of batch_size="
                f"{tuple(observation_spec.shape)}: give it a network for each of these rows"
            )
        return demonstration


class BehaviorLookup(DemonstrationLookup):
    """Task inference by GWR-B: the behavior ``b`` of an episode (Alg. 1).

    At reset, ``b = w_c``, the weights of the node that best matches the demonstration. At the end
    of an episode GWR-B adapts to its demonstration. For the arguments, see `DemonstrationLookup`,
    whose ``network`` is a `GWRB`.

    Algorithm 1 adapts at the start of the episode, right after reading ``b``; no lookup happens in
    between, so every ``b`` is the same. In TorchRL, however, a reset need not start an episode:
    ``check_env_specs``, collectors on construction and interrupted episodes reset, too.

    Reads ``demo_embedding`` float32 ``[*B, 32]`` and ``done``; writes ``behavior`` float32 ``[*B,
    32]`` and, for logging, ``behavior_node`` int64 ``[*B]``. For the ablation without GWR-B, in
    which the demonstration's embedding is the behavior, replace it by
    ``RenameTransform(["demo_embedding"], ["behavior"], create_copy=True)``.

    Examples:
        >>> from types import SimpleNamespace
        >>> from torchrl.envs import Compose, PendulumEnv, StepCounter, TransformedEnv
        >>> from bgpo_trl.modules.gwr import GWRB
        >>> from bgpo_trl.transforms import DemonstrationSource, TaskSchedule
        >>> bank = SimpleNamespace(embedding=torch.rand(6, 32), task=torch.arange(6) % 3)
        >>> source = DemonstrationSource(bank, TaskSchedule())
        >>> lookup = BehaviorLookup(GWRB(32), learn=True)
        >>> env = TransformedEnv(PendulumEnv(), Compose(StepCounter(50), source, lookup))
        >>> data = env.rollout(50)
        >>> data["behavior"].shape, data["behavior_node"].unique().numel()
        (torch.Size([50, 32]), 1)
    """

    written = ("behavior", "behavior_node")

    def seed_rows(self, seeds: Sequence[int]) -> None:
        """Draw the random nodes of GWR-B anew, in the networks that learn and have not begun to."""
        if self.learn:
            self.network.redraw(generators(seeds, "gwr"))

    def look_up(self, embedding: Tensor) -> tuple[Tensor, Tensor]:
        """Return behavior and node for embeddings ``[*B, 32]``."""
        match = self.network.lookup(embedding)
        return match.embedding, match.node

    def _entries(self, observation_spec: Composite) -> dict[NestedKey, TensorSpec]:
        behavior_key, node_key = self.out_keys
        return {
            behavior_key: self._demonstration_spec(observation_spec).clone(),
            node_key: unbounded(observation_spec, dtype=torch.int64),
        }


class GroupLookup(DemonstrationLookup):
    """Group of an episode's demonstration, which selects the expert and the replay.

    For the arguments, see `DemonstrationLookup`, whose ``network`` is a list of `BehaviorGroups`,
    one for each row. With a novelty above 1, the demonstration belongs to no known group and is
    played by the nearest.

    Reads ``demo_embedding`` float32 ``[*B, 32]`` and ``done``; writes ``group`` int64 ``[*B]`` and
    ``group_novelty`` float32 ``[*B]``.

    Examples:
        >>> from types import SimpleNamespace
        >>> from torchrl.envs import Compose, PendulumEnv, StepCounter, TransformedEnv
        >>> from bgpo_trl.modules.behavior_groups import BehaviorGroups
        >>> from bgpo_trl.transforms import DemonstrationSource, TaskSchedule
        >>> bank = SimpleNamespace(embedding=torch.rand(6, 32), task=torch.arange(6) % 3)
        >>> source = DemonstrationSource(bank, TaskSchedule())
        >>> lookup = GroupLookup([BehaviorGroups(32)], learn=True)
        >>> env = TransformedEnv(PendulumEnv(), Compose(StepCounter(50), source, lookup))
        >>> env.rollout(50)["group"].unique()
        tensor([0])
    """

    written = ("group", "group_novelty")
    network: Sequence[BehaviorGroups]

    def look_up(self, embedding: Tensor) -> tuple[Tensor, Tensor]:
        """Return group and novelty for embeddings ``[*B, 32]``."""
        pairs = zip(self.network, self._of_rows(embedding), strict=True)
        matches, shape = [groups.lookup(phi) for groups, phi in pairs], embedding.shape[:-1]
        group = torch.stack([match.group for match in matches]).view(shape)
        return group, torch.stack([match.novelty for match in matches]).view(shape)

    def _of_rows(self, embedding: Tensor) -> Tensor:
        """Return embeddings ``[*B, d]`` by row, ``[S, *, d]``."""
        n_rows = len(self.network)
        if n_rows > 1 and embedding.shape[0] != n_rows:
            raise ValueError(
                f"there are groups for {n_rows} rows, not for embeddings {[*embedding.shape]}"
            )
        return embedding.reshape(n_rows, -1, embedding.shape[-1])

    def _adapt(self, embedding: Tensor, ended: Tensor) -> None:
        for row in ended.flatten().nonzero().flatten().tolist():
            self.network[row].adapt(self._of_rows(embedding)[row, 0])

    def _fits(self, batch_size: torch.Size) -> bool:
        return batch_size.numel() == len(self.network) and len(batch_size) <= 1

    def _entries(self, observation_spec: Composite) -> dict[NestedKey, TensorSpec]:
        demonstration = self._demonstration_spec(observation_spec)
        group_key, novelty_key = self.out_keys
        return {
            group_key: unbounded(observation_spec, dtype=torch.int64),
            novelty_key: unbounded(observation_spec, dtype=demonstration.dtype),
        }
