"""Task inference: from a demonstration to its behavior (paper, Sec. III-B) and its group."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec

from bgpo_trl.errors import missing_key
from bgpo_trl.modules.behavior_groups import BehaviorGroups
from bgpo_trl.seeding import generators
from bgpo_trl.transforms._episode import EpisodeTransform, ending, starting, unbounded


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

    Raises:
        ValueError: If the demonstration's embedding is missing, or the network is to learn from an
            environment of another batch size.
    """

    reads = ("demo_embedding",)

    def __init__(self, network: Any, *, learn: bool) -> None:
        super().__init__()
        self.network = network
        self.learn = learn

    def look_up(self, embedding: Tensor) -> tuple[Tensor, ...]:
        """Return the entries to write for embeddings ``[*B, d]``."""
        raise NotImplementedError

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Look up the demonstrations of any TensorDict, without learning."""
        embedding = tensordict.get("demo_embedding", None)
        if embedding is None:
            raise missing_key(type(self).__name__, tensordict, ["demo_embedding"])
        for key, value in zip(self.writes, self.look_up(embedding), strict=True):
            # The network may compute in another dtype than the one that the spec announces.
            tensordict.set(key, value.to(embedding.dtype) if value.is_floating_point() else value)
        return tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self.forward(tensordict_reset)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        for key in self.writes:
            next_tensordict.set(key, tensordict.get(key))
        if self.learn:
            ended = ending(tensordict, next_tensordict)
            if ended.any():
                self._learn(tensordict, next_tensordict, ended)
        return next_tensordict

    def _learn(
        self, tensordict: TensorDictBase, next_tensordict: TensorDictBase, ended: Tensor
    ) -> None:
        """Learn from the episodes of the rows that ``ended``, bool ``[*B]``."""
        self.network.adapt(tensordict.get("demo_embedding"), mask=ended)

    def _fits(self, batch_size: torch.Size) -> bool:
        """Return whether there is a network for each row of an environment."""
        return batch_size == self.network.batch_size

    def _demonstration_spec(self, observation_spec: Composite) -> TensorSpec:
        """Return the spec of the demonstration's embedding, after checking the batch size."""
        demonstration = self._read_spec(observation_spec, "demo_embedding", "DemonstrationSource")
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

    writes = ("behavior", "behavior_node")

    def seed_rows(self, seeds: Sequence[int]) -> None:
        """Draw the random nodes of GWR-B anew, in the networks that learn and have not begun to."""
        if self.learn:
            self.network.redraw(generators(seeds, "gwr"))

    def look_up(self, embedding: Tensor) -> tuple[Tensor, Tensor]:
        """Return behavior and node for embeddings ``[*B, 32]``."""
        match = self.network.lookup(embedding)
        return match.embedding, match.node

    def _entries(self, observation_spec: Composite) -> dict[str, TensorSpec]:
        return {
            "behavior": self._demonstration_spec(observation_spec).clone(),
            "behavior_node": unbounded(observation_spec, dtype=torch.int64),
        }


class GroupLookup(DemonstrationLookup):
    """Group of an episode's demonstration, and the group whose expert plays the episode.

    At reset, the demonstration's group is looked up. Without ``starts``, its expert plays; with a
    novelty above 1, the demonstration belongs to no known group and is played by the nearest. With
    ``starts`` and ``learn=True``, experts of other groups are tried where the episode starts unlike
    the demonstrations of the group (`BehaviorGroups.expert`). When the episode ends, the groups
    learn its demonstration, count its success, and may be joined.

    Reads ``demo_embedding`` float32 ``[*B, 32]`` and ``done``, and with ``starts`` also ``latent``
    float32 ``[*B, 64]``, ``demo_index`` int64 ``[*B]`` and ``success`` bool ``[*B, 1]``. Writes
    ``group`` int64 ``[*B]``, ``group_novelty`` float32 ``[*B]``, ``group_fits`` bool ``[*B]``,
    False in a trial, and ``expert`` int64 ``[*B]``, the number of the group whose expert plays.

    Args:
        network: Groups of each row.
        learn: As for `DemonstrationLookup`.
        starts: First latent of each demonstration by its index, float32 ``[N, 64]``.

    Attributes:
        tries: Whether experts are tried and successes counted: False for episodes that no expert
            plays.

    Raises:
        ValueError: As from `DemonstrationLookup`.

    Examples:
        >>> from types import SimpleNamespace
        >>> from torchrl.envs import Compose, PendulumEnv, StepCounter, TransformedEnv
        >>> from bgpo_trl.modules.behavior_groups import BehaviorGroups
        >>> from bgpo_trl.transforms import DemonstrationSource, TaskSchedule
        >>> bank = SimpleNamespace(embedding=torch.rand(6, 32), task=torch.arange(6) % 3)
        >>> source = DemonstrationSource(bank, TaskSchedule())
        >>> lookup = GroupLookup([BehaviorGroups(32)], learn=True)
        >>> env = TransformedEnv(PendulumEnv(), Compose(StepCounter(50), source, lookup))
        >>> env.rollout(50)["expert"].unique()
        tensor([0])
    """

    reads = ("demo_embedding", "latent", "demo_index", "success")
    writes = ("group", "group_novelty", "group_fits", "expert")
    network: Sequence[BehaviorGroups]
    tries: bool = True

    def __init__(
        self,
        network: Sequence[BehaviorGroups],
        *,
        learn: bool,
        starts: Tensor | None = None,
    ) -> None:
        super().__init__(network, learn=learn)
        self.starts = starts

    def get_extra_state(self) -> list[dict[str, Any]]:
        """Return the states of the groups, for ``state_dict``."""
        return [groups.state_dict() for groups in self.network]

    def set_extra_state(self, state: list[dict[str, Any]]) -> None:
        """Restore the states of the groups.

        Raises:
            ValueError: If they are of another number of rows, or as from `BehaviorGroups`.
        """
        for groups, saved in zip(self.network, state, strict=True):
            groups.load_state_dict(saved)

    def look_up(self, embedding: Tensor) -> tuple[Tensor, ...]:
        """Return the entries for embeddings ``[*B, 32]``; the expert is that of the group."""
        pairs = zip(self.network, self._of_rows(embedding), strict=True)
        matches, shape = [groups.lookup(phi) for groups, phi in pairs], embedding.shape[:-1]
        group = torch.stack([match.group for match in matches]).view(shape)
        novelty = torch.stack([match.novelty for match in matches]).view(shape)
        return group, novelty, torch.ones_like(group, dtype=torch.bool), group.clone()

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        self.forward(tensordict_reset)
        if self.learn and self.tries and self.starts is not None:
            latent = self._of_rows(tensordict_reset.get("latent"))[:, 0]
            group, _, fits, expert = self._written(tensordict_reset)
            for row in starting(tensordict).flatten().nonzero().flatten().tolist():
                expert[row], fits[row] = self.network[row].expert(latent[row], int(group[row]))
        return tensordict_reset

    def _learn(
        self, tensordict: TensorDictBase, next_tensordict: TensorDictBase, ended: Tensor
    ) -> None:
        phi = self._of_rows(tensordict.get("demo_embedding"))[:, 0]
        group, _, fits, expert = self._written(tensordict)
        for row in ended.flatten().nonzero().flatten().tolist():
            groups = self.network[row]
            if self.starts is None:
                groups.adapt(phi[row])
                continue
            index = int(tensordict.get("demo_index").flatten()[row])
            if index >= len(self.starts):
                raise ValueError(
                    f"starts has {len(self.starts)} rows, demonstration {index} was shown: give "
                    "the first latent of each demonstration of the bank"
                )
            groups.adapt(phi[row], self.starts[index])
            if self.tries:
                success = bool(next_tensordict.get("success").flatten()[row])
                groups.end(int(group[row]), int(expert[row]), fits=bool(fits[row]), success=success)

    def _written(self, tensordict: TensorDictBase) -> list[Tensor]:
        """Return views of the entries written, by row ``[S]``."""
        return [tensordict.get(key).view(-1) for key in self.writes]

    def _entries(self, observation_spec: Composite) -> dict[str, TensorSpec]:
        demonstration = self._demonstration_spec(observation_spec)
        if self.learn and self.starts is not None:
            for key, source in (
                ("latent", "FrameEncoder"),
                ("demo_index", "DemonstrationSource"),
                ("success", "an environment with successes"),
            ):
                self._read_spec(observation_spec, key, source)
        dtypes = (torch.int64, demonstration.dtype, torch.bool, torch.int64)
        return {
            key: unbounded(observation_spec, dtype=dtype)
            for key, dtype in zip(self.writes, dtypes, strict=True)
        }

    def _fits(self, batch_size: torch.Size) -> bool:
        return batch_size.numel() == len(self.network) and len(batch_size) <= 1

    def _of_rows(self, entry: Tensor) -> Tensor:
        """Return an entry ``[*B, f]`` by row, ``[S, *, f]``."""
        n_rows = len(self.network)
        if n_rows > 1 and entry.shape[0] != n_rows:
            raise ValueError(
                f"there are groups for {n_rows} rows, not for embeddings {[*entry.shape]}"
            )
        return entry.reshape(n_rows, -1, entry.shape[-1])
