"""Group inference: from a demonstration to its group of behaviors."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.data import Composite, TensorSpec

from bgpo_trl.modules.behavior_groups import BehaviorGroups
from bgpo_trl.transforms._episode import DemonstrationLookup, unbounded


class GroupLookup(DemonstrationLookup):
    """Group of an episode's demonstration, which selects the expert and the replay.

    For the arguments, see `DemonstrationLookup`, whose ``network`` is ``groups``. With a novelty
    above 1, the demonstration belongs to no known group and is played by the nearest.

    Reads ``demo_embedding`` float32 ``[*B, 32]`` and ``done``; writes ``group`` int64 ``[*B]`` and
    ``group_novelty`` float32 ``[*B]``.

    Examples:
        >>> from types import SimpleNamespace
        >>> from torchrl.envs import Compose, PendulumEnv, StepCounter, TransformedEnv
        >>> from bgpo_trl.transforms import DemonstrationSource, TaskSchedule
        >>> bank = SimpleNamespace(embedding=torch.rand(6, 32), task=torch.arange(6) % 3)
        >>> source = DemonstrationSource(bank, TaskSchedule())
        >>> lookup = GroupLookup(BehaviorGroups(32), learn=True)
        >>> env = TransformedEnv(PendulumEnv(), Compose(StepCounter(50), source, lookup))
        >>> env.rollout(50)["group"].unique()
        tensor([0])
    """

    def __init__(
        self,
        groups: BehaviorGroups,
        *,
        learn: bool,
        in_keys: Sequence[NestedKey] = ("demo_embedding",),
        out_keys: Sequence[NestedKey] = ("group", "group_novelty"),
    ) -> None:
        super().__init__(groups, learn=learn, in_keys=in_keys, out_keys=out_keys)

    @property
    def groups(self) -> BehaviorGroups:
        """The groups."""
        return self.network

    def look_up(self, embedding: Tensor) -> tuple[Tensor, Tensor]:
        """Return group and novelty for embeddings ``[*B, 32]``."""
        match = self.groups.lookup(embedding)
        return match.group, match.novelty

    def _entries(self, observation_spec: Composite) -> dict[NestedKey, TensorSpec]:
        demonstration = self._demonstration_spec(observation_spec)
        group_key, novelty_key = self.out_keys
        return {
            group_key: unbounded(observation_spec, dtype=torch.int64),
            novelty_key: unbounded(observation_spec, dtype=demonstration.dtype),
        }
