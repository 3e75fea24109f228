"""Which task and which demonstration an episode starts with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import Protocol

import numpy as np
import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec

from bgpo_trl.transforms._episode import EpisodeTransform, ending, starting, unbounded


@dataclass(frozen=True)
class TaskSchedule:
    """When tasks are presented: the only difference between concurrent and continual learning.

    The defaults are the paper's continual experiment (section IV-C); its concurrent one (section
    IV-B) is `TaskSchedule(starts=(0, 0, 0))`.

    Attributes:
        starts: for each task, the number of episodes after which it is presented.
        cumulative: a presented task stays available. If False, only the newest ones are.

    Raises:
        ValueError: if no task is available from the start, or a start is negative.

    Examples:
        >>> TaskSchedule().available(torch.tensor([0, 6_999, 7_000, 13_000]))
        tensor([[ True, False, False],
                [ True, False, False],
                [ True,  True, False],
                [ True,  True,  True]])
        >>> TaskSchedule(cumulative=False).available(torch.tensor(7_000))
        tensor([False,  True, False])
        >>> TaskSchedule().presented(torch.tensor(7_000))
        tensor([ True, False, False])
    """

    starts: tuple[int, ...] = (0, 7_000, 13_000)
    cumulative: bool = True

    def __post_init__(self) -> None:
        if not self.starts or min(self.starts) != 0:
            raise ValueError(
                f"starts must hold a 0, for a task to start with, and nothing below: {self.starts}"
            )
        if not all(isinstance(start, Integral) for start in self.starts):
            raise ValueError(f"starts must be whole numbers of episodes: {self.starts}")

    @property
    def n_tasks(self) -> int:
        """Number of tasks, presented or not."""
        return len(self.starts)

    def available(self, episode: Tensor) -> Tensor:
        """Tell which tasks an episode may be about.

        Args:
            episode: episodes that went before, int64 `[*B]`.

        Returns:
            bool `[*B, n_tasks]`.
        """
        presented = self.presented(episode + 1)
        if self.cumulative:
            return presented
        starts = torch.tensor(self.starts, device=episode.device)
        newest = torch.where(presented, starts, -1).amax(-1, keepdim=True)
        return starts == newest

    def presented(self, episodes: Tensor) -> Tensor:
        """Tell which tasks any of the episodes so far could have been about.

        Args:
            episodes: number of episodes so far, int64 `[*B]`.

        Returns:
            bool `[*B, n_tasks]`.
        """
        return torch.tensor(self.starts, device=episodes.device) < episodes.unsqueeze(-1)


class Bank(Protocol):
    """Embedded demonstrations, as `bgpo_trl.data.recording.DemonstrationBank` holds them."""

    @property
    def embedding(self) -> Tensor:
        """The embeddings phi_d, float32 `[N, 32]`."""
        ...

    @property
    def task(self) -> Tensor:
        """The task that each is a demonstration of, int64 `[N]`."""
        ...


class DemonstrationSource(EpisodeTransform):
    """Draws the task and the demonstration of each episode (Alg. 1, "Sample demonstration d").

    1. At reset, before the environment itself is reset, each row whose episode starts gets one of
       the tasks that the schedule has presented to it so far, and one of the demonstrations of that
       task, both uniformly. The environment finds the task in the TensorDict it is reset with, and
       so knows what to reward.
    2. After it, task, embedding and index of the demonstration are in the observation; they stay
       the same until the episode is over.
    3. When it is over (`done`), the row's `episode` counts one more.

    Rows (seeds) share nothing: each has its own count and its own stream of draws, so that it
    follows the same episodes alone as in any batch. A draw depends on nothing but the stream and
    the count. So an episode that is not played to its end leaves no trace, be it the one that
    `check_env_specs` or a `Collector` starts on construction, or one that an interruption cut
    short: it starts again with the same demonstration. And to resume, `state_dict` (streams and
    counts) is all there is to restore.

    Reads `done`; writes `task` int64 `[*B]`, `demo_embedding` float32 `[*B, 32]`, `demo_index`
    int64 `[*B]` (position in the bank). An environment that is itself made of transformed
    environments must have `task` in its `state_spec`, or it never sees it.

    Args:
        bank: the demonstrations, with tensors `embedding` `[N, 32]` and `task` `[N]`.
        schedule: what is presented when: a `TaskSchedule`, or anything with its `n_tasks` and
            `available`.
        batch_size: batch size of the environment; `()` for a single one.
        generator: source of the streams, one for all rows or a sequence with one a row. It is only
            read here. None: torch's default generator.
        follow: draw from what this other source has presented by now, rather than by the own count:
            evaluation tests on the tasks of training with demonstrations of its own. Its batch
            size must be the first dimensions of this one's.
        out_keys: names for task, embedding and index.
        done_key: the `done` that ends an episode.

    Raises:
        ValueError: for a bank of wrong shapes or without demonstrations of a task, a wrong number
            of generators, an environment of another batch size or one that does not take the task.

    Examples:
        >>> from types import SimpleNamespace
        >>> from torchrl.envs import Compose, PendulumEnv, StepCounter, TransformedEnv
        >>> bank = SimpleNamespace(embedding=torch.rand(6, 32), task=torch.arange(6) % 3)
        >>> source = DemonstrationSource(bank, TaskSchedule(starts=(0, 2, 4)))
        >>> env = TransformedEnv(PendulumEnv(), Compose(StepCounter(50), source))
        >>> for _ in range(2):
        ...     data = env.rollout(50)
        >>> data["demo_embedding"].shape, data["task"].unique()
        (torch.Size([50, 32]), tensor([0]))
        >>> source.episode
        tensor(2)
    """

    episode: Tensor
    _stream: Tensor
    _embedding: Tensor
    _task: Tensor
    _demo_index: Tensor

    def __init__(
        self,
        bank: Bank,
        schedule: TaskSchedule,
        *,
        batch_size: Sequence[int] = (),
        generator: torch.Generator | Sequence[torch.Generator] | None = None,
        follow: DemonstrationSource | None = None,
        out_keys: Sequence[NestedKey] = ("task", "demo_embedding", "demo_index"),
        done_key: NestedKey = "done",
    ) -> None:
        super().__init__((), out_keys, done_key)
        batch_size = torch.Size(batch_size)
        n_rows = batch_size.numel()
        if bank.embedding.ndim != 2 or bank.task.shape != bank.embedding.shape[:1]:
            raise ValueError(
                "a bank needs embedding [N, 32] and task [N], got shapes "
                f"{tuple(bank.embedding.shape)} and {tuple(bank.task.shape)}"
            )
        if not bank.embedding.isfinite().all():
            raise ValueError("the bank holds NaN or Inf: embed the demonstrations anew")
        tasks = bank.task.cpu().numpy()
        self._demonstrations = [np.flatnonzero(tasks == t) for t in range(schedule.n_tasks)]
        missing = [t for t, found in enumerate(self._demonstrations) if not len(found)]
        if missing:
            raise ValueError(
                f"the bank has no demonstration of task {missing[0]} of the schedule: record some, "
                f"or let the schedule have fewer than {schedule.n_tasks} tasks"
            )
        generators = generator if isinstance(generator, Sequence) else [generator] * n_rows
        if len(generators) != n_rows:
            raise ValueError(f"generator must be one or {n_rows}, one a row; got {len(generators)}")
        if follow is not None and batch_size[: follow.episode.ndim] != follow.episode.shape:
            raise ValueError(
                f"batch_size {tuple(batch_size)} must start with that of the source to follow, "
                f"{tuple(follow.episode.shape)}"
            )
        self.schedule = schedule
        self._follow = [] if follow is None else [follow]  # a list, as it is no part of this module
        streams = [
            torch.randint(2**63 - 1, (), generator=g, device=None if g is None else g.device)
            for g in generators
        ]
        self.register_buffer("_stream", torch.tensor(streams).view(batch_size))
        self.register_buffer("episode", torch.zeros(batch_size, dtype=torch.int64))
        self.register_buffer("_embedding", bank.embedding, persistent=False)
        self.register_buffer("_task", bank.task, persistent=False)
        self.register_buffer("_demo_index", torch.zeros_like(self.episode), persistent=False)

    def _draw(self, rows: Tensor) -> None:
        presented = self._follow[0].episode if self._follow else self.episode
        extra = self.episode.ndim - presented.ndim
        available = self.schedule.available(presented[(..., *[None] * extra)])
        available = available.expand(*rows.shape, -1)[rows].tolist()
        episodes, streams = self.episode[rows].tolist(), self._stream[rows].tolist()
        drawn = []
        for tasks, stream, episode in zip(available, streams, episodes, strict=True):
            rng = np.random.default_rng((stream, episode))
            choices = [found for t, found in zip(tasks, self._demonstrations, strict=True) if t]
            demonstrations = choices[rng.integers(len(choices))]
            drawn.append(int(demonstrations[rng.integers(len(demonstrations))]))
        self._demo_index[rows] = torch.tensor(drawn, dtype=torch.int64, device=rows.device)

    def _reset_env_preprocess(self, tensordict: TensorDictBase | None) -> TensorDictBase:
        super()._reset_env_preprocess(tensordict)
        if tensordict is None:
            tensordict = TensorDict({}, self.episode.shape, device=self.episode.device)
        self._draw(starting(tensordict, self.done_key))
        return tensordict.set(self.out_keys[0], self._task[self._demo_index])

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        task_key, embedding_key, index_key = self.out_keys
        task = self._task[self._demo_index]
        reported = tensordict_reset.get(task_key, None)
        if reported is None:
            tensordict_reset.set(task_key, task)
        elif (reported.reshape(task.shape) != task)[starting(tensordict, self.done_key)].any():
            raise ValueError(
                f"the environment did not take the task drawn for it: it must read {task_key!r} "
                "from the TensorDict it is reset with, and have it in its state_spec"
            )
        tensordict_reset.set(embedding_key, self._embedding[self._demo_index])
        return tensordict_reset.set(index_key, self._demo_index.clone())

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        task_key, *own_keys = self.out_keys
        if next_tensordict.get(task_key, None) is None:
            own_keys.append(task_key)
        for key in own_keys:
            next_tensordict.set(key, tensordict[key])
        self.episode += ending(tensordict, next_tensordict, self.done_key)
        return next_tensordict

    def _entries(self, observation_spec: Composite) -> dict[NestedKey, TensorSpec]:
        if observation_spec.shape != self.episode.shape:
            raise ValueError(
                f"DemonstrationSource was made for batch_size={tuple(self.episode.shape)}, but the "
                f"environment has {tuple(observation_spec.shape)}"
            )
        task_key, embedding_key, index_key = self.out_keys
        n_features = self._embedding.shape[-1]
        index = unbounded(observation_spec, dtype=torch.int64)
        entries: dict[NestedKey, TensorSpec] = {
            embedding_key: unbounded(observation_spec, n_features, dtype=self._embedding.dtype),
            index_key: index,
        }
        if task_key not in observation_spec.keys(True, True):
            entries[task_key] = index.clone()
        return entries
