"""Test episodes: frozen weights, frozen GWR-B, no noise, held-out demonstrations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import Compose, TransformedEnv

from bgpo_trl.algorithms.algorithm import Algorithm, clip, observe
from bgpo_trl.configs import AlgorithmConfig
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.encoders.representation import Representation
from bgpo_trl.envs import NicoEnv
from bgpo_trl.seeding import stream_seed


@dataclass(frozen=True)
class Snapshot:
    """What a seed's evaluation depends on, taken at one moment of its training.

    Attributes:
        episode: Training episodes before it.
        env_steps: Environment steps before it.
        presented: Which tasks were presented so far, bool ``[T]``.
        policy: What the policy depends on, from `Algorithm.freeze`.
    """

    episode: int
    env_steps: int
    presented: Tensor
    policy: dict[str, Any]


@dataclass(frozen=True)
class TestResult:
    """Outcome of the test episodes of one evaluation of each seed.

    Attributes:
        success: Bool ``[S, T, M]``: seeds, tasks, episodes of a task; also the extrinsic return.
        steps: Length of the episodes, int64 ``[S, T, M]``.
    """

    __test__ = False  # Not a test case of pytest's.

    success: Tensor
    steps: Tensor


class Evaluator:
    """Tests snapshots of all seeds as one batch.

    Seeds reach an evaluation at different times. Each leaves a `Snapshot`; when all have, their
    test episodes run side by side. Starts and demonstrations of an evaluation follow from the seed
    and its number alone.

    Args:
        config: The algorithm's hyperparameters.
        seeds: As in training.
        n_tasks: Number of tasks, presented or not.
        episodes: Test episodes ``M`` of each task.
        bank: Held-out demonstrations.
        encoders: As in training.

    Raises:
        ValueError: If there is no demonstration of one of the tasks.
    """

    def __init__(
        self,
        config: AlgorithmConfig,
        *,
        seeds: Sequence[int],
        n_tasks: int,
        episodes: int,
        bank: DemonstrationBank,
        encoders: Representation | None,
    ) -> None:
        self.max_steps = config.max_steps
        self._state_key = config.state
        self.seeds = tuple(seeds)
        self.shape = (len(seeds), n_tasks, episodes)
        self._rows_of = [torch.nonzero(bank.task == task).flatten() for task in range(n_tasks)]
        missing = [task for task, rows in enumerate(self._rows_of) if not len(rows)]
        if missing:
            raise ValueError(
                f"the bank has no held-out demonstration of task {missing[0]}: hold some out of "
                "each task"
            )
        self._bank = bank
        self.simulation = NicoEnv(
            bank.tasks,
            batch_size=self.shape,
            observation="pixels" if config.state == "latent" else "state",
        )
        self.env = TransformedEnv(
            self.simulation, Compose([observe(config, encoders), clip(config)])
        )
        self._task = torch.arange(n_tasks)[:, None].expand(self.shape).contiguous()

    def _rng(self, seed: int, number: int) -> np.random.Generator:
        return np.random.default_rng([stream_seed(seed, "evaluation"), number])

    def take(self, algorithm: Algorithm, index: int, number: int, env_steps: int) -> Snapshot:
        """Returns a snapshot of one seed.

        Args:
            algorithm: In training.
            index: Position of the seed in the batch.
            number: How many evaluations of this seed were before.
            env_steps: The seed's environment steps so far.
        """
        rng = self._rng(self.seeds[index], number)
        drawn = torch.stack(
            [
                rows[torch.from_numpy(rng.integers(len(rows), size=self.shape[2]))]
                for rows in self._rows_of
            ]
        )
        episode = int(algorithm.source.episode[index])
        return Snapshot(
            episode=episode,
            env_steps=env_steps,
            presented=algorithm.source.schedule.presented(torch.tensor(episode)),
            policy=algorithm.freeze(
                index,
                self._bank.embedding[drawn],
                self._bank.task[drawn],
                torch.Generator().manual_seed(int(rng.integers(2**63 - 1))),
            ),
        )

    @torch.no_grad()
    def run(
        self,
        snapshots: Sequence[Snapshot],
        number: int,
        algorithm: Algorithm,
        watch: Callable[[], object] = lambda: None,
    ) -> TestResult:
        """Plays the test episodes of all tasks presented to each seed.

        Args:
            snapshots: One of each seed.
            number: How many evaluations were before.
            algorithm: The one that left them; what it has learned since makes no difference.
            watch: Called at the start and after each step, with `simulation` there to be looked at.

        Returns:
            Success and length; both 0 where a task was not yet presented.
        """
        device = algorithm.device
        policy = TensorDict.maybe_dense_stack([TensorDict(s.policy) for s in snapshots]).to(device)
        starts = [
            self._rng(seed, number).integers(2**32, size=self.shape[1:]) for seed in self.seeds
        ]
        self.simulation.seed_rows(np.stack(starts).ravel().tolist())
        presented = torch.stack([s.presented for s in snapshots])
        active = presented[:, :, None].expand(self.shape).clone()
        success, steps = torch.zeros(self.shape, dtype=torch.bool), torch.zeros(self.shape).long()
        state = self.env.reset(TensorDict({"task": self._task}, self.shape))
        watch()
        for _ in range(self.max_steps):
            seen = state[self._state_key].to(device)
            state.set("action", algorithm.act_frozen(policy, seen).cpu())
            state.set("_step", active)
            state = self.env.step(state)["next"]
            watch()
            steps += active
            success |= state["terminated"].squeeze(-1) & active
            active = active & ~success
            if not active.any():
                break
        return TestResult(success, steps)


@torch.no_grad()
def evaluate_random_policy(
    *, tasks: Sequence[str], episodes: int, seed: int = 0, max_steps: int = 50
) -> Tensor:
    """Returns the success rate of uniformly random actions on each task, float32 ``[T]``."""
    shape = (len(tasks), episodes)
    env = NicoEnv(
        tasks, batch_size=shape, seed=stream_seed(seed, "random policy") // 2, observation="state"
    )
    generator = torch.Generator().manual_seed(seed)
    task = torch.arange(len(tasks))[:, None].expand(shape).contiguous()
    state = env.reset(TensorDict({"task": task}, shape))
    for _ in range(max_steps):
        state.set("action", torch.rand(*shape, 4, generator=generator) * 2 - 1)
        state = env.step(state)["next"]
    return state["terminated"].squeeze(-1).float().mean(-1)
