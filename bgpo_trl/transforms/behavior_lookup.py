"""Task inference: from a demonstration to its behavior (paper, Sec. III-B and III-C)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.data import Composite, TensorSpec

from bgpo_trl.modules.gwr import GWRB
from bgpo_trl.seeding import generators
from bgpo_trl.transforms._episode import DemonstrationLookup, unbounded


class BehaviorLookup(DemonstrationLookup):
    """Task inference by GWR-B: the behavior ``b`` of an episode (Alg. 1).

    At reset, ``b = w_c``, the weights of the node that best matches the demonstration. At the end
    of an episode GWR-B adapts to its demonstration. For the arguments, see `DemonstrationLookup`,
    whose ``network`` is ``gwr``.

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
        >>> from bgpo_trl.transforms import DemonstrationSource, TaskSchedule
        >>> bank = SimpleNamespace(embedding=torch.rand(6, 32), task=torch.arange(6) % 3)
        >>> source = DemonstrationSource(bank, TaskSchedule())
        >>> lookup = BehaviorLookup(GWRB(32), learn=True)
        >>> env = TransformedEnv(PendulumEnv(), Compose(StepCounter(50), source, lookup))
        >>> data = env.rollout(50)
        >>> data["behavior"].shape, data["behavior_node"].unique().numel()
        (torch.Size([50, 32]), 1)
    """

    def __init__(
        self,
        gwr: GWRB,
        *,
        learn: bool,
        in_keys: Sequence[NestedKey] = ("demo_embedding",),
        out_keys: Sequence[NestedKey] = ("behavior", "behavior_node"),
    ) -> None:
        super().__init__(gwr, learn=learn, in_keys=in_keys, out_keys=out_keys)

    @property
    def gwr(self) -> GWRB:
        """The network."""
        return self.network

    def seed_rows(self, seeds: Sequence[int]) -> None:
        """Draw the random nodes of GWR-B anew, in the networks that learn and have not begun to."""
        if self.learn:
            self.gwr.redraw(generators(seeds, "gwr"))

    def look_up(self, embedding: Tensor) -> tuple[Tensor, Tensor]:
        """Return behavior and node for embeddings ``[*B, 32]``."""
        match = self.gwr.lookup(embedding)
        return match.embedding, match.node

    def _entries(self, observation_spec: Composite) -> dict[NestedKey, TensorSpec]:
        behavior_key, node_key = self.out_keys
        return {
            behavior_key: self._demonstration_spec(observation_spec).clone(),
            node_key: unbounded(observation_spec, dtype=torch.int64),
        }
