"""Task inference: from a demonstration to the behavior it shows (paper, section III-B and C)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.data import Composite, TensorSpec

from bgpo_trl.modules.gwr import GWRB
from bgpo_trl.transforms._episode import DemonstrationLookup, unbounded


class BehaviorLookup(DemonstrationLookup):
    """Infers the task of an episode with GWR-B: its behavior `b` (Alg. 1).

    1. At reset, `b = w_c`, the weights of the node that matches the demonstration best, and the
       node's identity for logging. They stay the same until the episode is over.
    2. When it is over (`done`), and with `learn=True`, GWR-B adapts to its demonstration; the
       networks of the rows whose episode goes on are left alone.

    Algorithm 1 adapts right after it has taken `b`, at the start of the episode. Nobody asks GWR-B
    anything in between, so every `b` is the same as there. But in TorchRL a reset need not be the
    start of an episode: `check_env_specs` and collectors reset while they are being made, and an
    interrupted episode is begun again. GWR-B learns nothing from such; only a check that happens to
    play an episode to its end, within its three steps, has to be made with `learn = False`.

    Reads `demo_embedding` float32 `[*B, 32]` and `done`; writes `behavior` float32 `[*B, 32]` and
    `behavior_node` int64 `[*B]`. Called on its own, or in a replay buffer, it only looks up.

    The ablation without GWR-B, in which the demonstration itself is the behavior, has in its place
    `RenameTransform(["demo_embedding"], ["behavior"], create_copy=True)`.

    Args:
        gwr: the network, or one for each row: its `batch_size` is that of the environment, or (if
            it does not learn here) the first dimensions of it.
        learn: adapt GWR-B. May be changed at any time; `train()` and `eval()`, which TorchRL calls
            as it likes, have no influence on it.
        in_keys: name of the demonstration's embedding.
        out_keys: names for behavior and node.
        done_key: the `done` that ends an episode.

    Raises:
        ValueError: if GWR-B is to learn from an environment of another batch size, or no
            demonstration is there to be looked up.

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
        done_key: NestedKey = "done",
    ) -> None:
        super().__init__(gwr, learn=learn, in_keys=in_keys, out_keys=out_keys, done_key=done_key)

    @property
    def gwr(self) -> GWRB:
        """The network."""
        return self.network

    def look_up(self, embedding: Tensor) -> tuple[Tensor, Tensor]:
        """Return behavior and node for embeddings `[*B, 32]`."""
        match = self.gwr.lookup(embedding)
        return match.embedding, match.node

    def _entries(self, observation_spec: Composite) -> dict[NestedKey, TensorSpec]:
        behavior_key, node_key = self.out_keys
        return {
            behavior_key: self._demonstration_spec(observation_spec).clone(),
            node_key: unbounded(observation_spec, dtype=torch.int64),
        }
