"""Task schedule, and draws of task and demonstration at the start of an episode."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import Protocol

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec

from bgpo_trl.errors import as_shape
from bgpo_trl.seeding import generators, one_each, row_seeds
from bgpo_trl.transforms._episode import EpisodeTransform, ending, starting, unbounded


@dataclass(frozen=True)
class TaskSchedule:
    """Times at which tasks are presented: the difference between concurrent and continual learning.

    The defaults are the paper's continual experiment (Sec. IV-C); the concurrent one (Sec. IV-B) is
    ``TaskSchedule(starts=(0, 0, 0))``.

    Attributes:
        starts: For each task, the number of episodes after which it is presented.
        cumulative: Whether presented tasks stay available; otherwise only the newest ones are.

    Raises:
        ValueError: If no task is available from the start, or a start is negative.

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
                f"starts must hold a 0, for the first task, and nothing below: {self.starts}"
            )
        if not all(isinstance(start, Integral) for start in self.starts):
            raise ValueError(f"starts must be whole numbers of episodes: {self.starts}")

    @property
    def n_tasks(self) -> int:
        """Number of tasks, presented or not."""
        return len(self.starts)

    def available(self, episode: Tensor) -> Tensor:
        """Return the tasks that may be drawn for an episode, bool ``[*B, n_tasks]``.

        Args:
            episode: Number of earlier episodes, int64 ``[*B]``.
        """
        presented = self.presented(episode + 1)
        if self.cumulative:
            return presented
        starts = torch.tensor(self.starts, device=episode.device)
        newest = torch.where(presented, starts, -1).amax(-1, keepdim=True)
        return starts == newest

    def presented(self, episodes: Tensor) -> Tensor:
        """Return the tasks that were available in any episode so far, bool ``[*B, n_tasks]``.

        Args:
            episodes: Number of episodes so far, int64 ``[*B]``.
        """
        return torch.tensor(self.starts, device=episodes.device) < episodes.unsqueeze(-1)


class Bank(Protocol):
    """Embedded demonstrations, such as `DemonstrationBank`."""

    @property
    def embedding(self) -> Tensor:
        """The embeddings phi_d, float32 ``[N, 32]``."""
        ...

    @property
    def task(self) -> Tensor:
        """The task of each demonstration, int64 ``[N]``."""
        ...


class DemonstrationSource(EpisodeTransform):
    """Task and demonstration of each episode, drawn at random (Alg. 1, "Sample demonstration d").

    1. Before the environment is reset, each row whose episode starts gets one of the tasks
       available to it, and one demonstration of that task, both drawn uniformly. The environment
       reads the task from the TensorDict of the reset.
    2. Task, embedding and index of the demonstration stay in the observation until the episode
       ends.
    3. When it ends (``done``), the row's ``episode`` count increases by 1.

    Each row (seed) has its own count and its own random stream, and so the same episodes alone as
    in any batch. A draw depends only on stream and count: an episode that is not played to its end
    (started by ``check_env_specs`` or a ``Collector`` on construction, or interrupted) starts again
    with the same demonstration, and ``state_dict`` (streams and counts) suffices to resume.

    Reads ``done``; writes ``task`` int64 ``[*B]``, ``demo_embedding`` float32 ``[*B, 32]`` and
    ``demo_index`` int64 ``[*B]`` (position in the bank). An environment that is made of transformed
    environments must have ``task`` in its ``state_spec``, in order to read it. A ``clone`` shares
    counts and streams, as TorchRL expects where it wraps an environment twice; of one by itself,
    take a ``copy.deepcopy``.

    Args:
        bank: The demonstrations; other dtypes become float32 and int64.
        schedule: A `TaskSchedule`, or any object with its ``n_tasks`` and ``available``.
        batch_size: Batch size of the environment, or its length; ``()`` is a single one.
        generator: Source of the streams, one for all rows or one per row, used only on
            construction; None: torch's default generator. ``env.set_seed`` replaces the streams.

    Raises:
        ValueError: If the bank has wrong shapes or no demonstration of a task, the number of
            generators is wrong, the environment has another batch size or ignores the task, or no
            task is available at a reset.

    Examples:
        >>> from types import SimpleNamespace
        >>> from torchrl.envs import Compose, PendulumEnv, StepCounter, TransformedEnv
        >>> bank = SimpleNamespace(embedding=torch.rand(6, 32), task=torch.arange(6) % 3)
        >>> source = DemonstrationSource(bank, TaskSchedule(starts=(0, 2, 4)))
        >>> env = TransformedEnv(PendulumEnv(), Compose(StepCounter(50), source))
        >>> data = env.rollout(50)
        >>> data["demo_embedding"].shape, data["task"].unique()
        (torch.Size([50, 32]), tensor([0]))
        >>> source.episode
        tensor(1)
    """

    writes = ("task", "demo_embedding", "demo_index")
    acts_at_end = True
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
        batch_size: int | Sequence[int] = (),
        generator: torch.Generator | Sequence[torch.Generator] | None = None,
    ) -> None:
        super().__init__()
        batch_size = as_shape(batch_size, "batch_size")
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
        missing = [t for t, rows in enumerate(self._demonstrations) if not len(rows)]
        if missing:
            raise ValueError(
                f"the bank has no demonstration of task {missing[0]} of the schedule: record some, "
                f"or use a schedule of fewer than {schedule.n_tasks} tasks"
            )
        sources = one_each(generator, n_rows)
        self.schedule = schedule
        self.register_buffer("_stream", _streams(sources).view(batch_size))
        self.register_buffer("episode", torch.zeros(batch_size, dtype=torch.int64))
        self.register_buffer("_embedding", bank.embedding.detach().float(), persistent=False)
        self.register_buffer("_task", bank.task.long(), persistent=False)
        self.register_buffer("_demo_index", torch.zeros_like(self.episode), persistent=False)

    def seed_rows(self, seeds: Sequence[int]) -> None:
        """Start anew: streams from a seed for each row, and counts, hence the schedule, at 0."""
        seeds = row_seeds(seeds, self.episode.numel())
        self._stream.copy_(_streams(generators(seeds, "demonstrations")).view_as(self._stream))
        self.episode.zero_()

    def _draw(self, rows: Tensor) -> None:
        available = self.schedule.available(self.episode)[rows].tolist()
        episodes, streams = self.episode[rows].tolist(), self._stream[rows].tolist()
        drawn = []
        for tasks, stream, episode in zip(available, streams, episodes, strict=True):
            rng = np.random.default_rng((stream, episode))
            choices = [some for t, some in zip(tasks, self._demonstrations, strict=True) if t]
            if not choices:
                raise ValueError(
                    f"no task of {type(self.schedule).__name__} is available after {episode} "
                    "episodes: let its available() return one at least"
                )
            demonstrations = choices[rng.integers(len(choices))]
            drawn.append(int(demonstrations[rng.integers(len(demonstrations))]))
        self._demo_index[rows] = torch.tensor(drawn, dtype=torch.int64, device=rows.device)

    def _reset_env_preprocess(self, tensordict: TensorDictBase | None) -> TensorDictBase:
        super()._reset_env_preprocess(tensordict)
        if tensordict is None:
            tensordict = TensorDict({}, self.episode.shape, device=self.episode.device)
        self._draw(starting(tensordict))
        return tensordict.set("task", self._task[self._demo_index].clone())

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        # Copies: without batch dimensions, indexing returns views of the bank.
        task = self._task[self._demo_index].clone()
        reported = tensordict_reset.get("task", None)
        if reported is None:
            tensordict_reset.set("task", task)
        elif (reported.reshape(task.shape) != task)[starting(tensordict)].any():
            raise ValueError(
                "the environment did not take the task drawn for it: it must read 'task' from the "
                "TensorDict it is reset with, and have it in its state_spec"
            )
        tensordict_reset.set("demo_embedding", self._embedding[self._demo_index].clone())
        return tensordict_reset.set("demo_index", self._demo_index.clone())

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        for key in self.writes:
            if key != "task" or next_tensordict.get("task", None) is None:
                next_tensordict.set(key, tensordict.get(key))
        self.episode += ending(tensordict, next_tensordict)
        return next_tensordict

    def _entries(self, observation_spec: Composite) -> dict[str, TensorSpec]:
        if observation_spec.shape != self.episode.shape:
            raise ValueError(
                f"DemonstrationSource was made for batch_size={tuple(self.episode.shape)}, but the "
                f"environment has {tuple(observation_spec.shape)}"
            )
        n_features = self._embedding.shape[-1]
        index = unbounded(observation_spec, dtype=torch.int64)
        entries: dict[str, TensorSpec] = {
            "demo_embedding": unbounded(observation_spec, n_features, dtype=torch.float32),
            "demo_index": index,
        }
        if "task" not in observation_spec.keys(True, True):
            entries["task"] = index.clone()
        return entries


def _streams(generators: Sequence[torch.Generator | None]) -> Tensor:
    """Draw the number of a stream from each generator, int64 ``[len(generators)]``."""
    streams = [
        torch.randint(2**63 - 1, (), generator=g, device=None if g is None else g.device)
        for g in generators
    ]
    return torch.tensor(streams)
