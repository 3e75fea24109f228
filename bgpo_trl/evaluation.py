"""Test episodes: frozen weights, frozen GWR-B, no noise, held-out demonstrations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor

from bgpo_trl.algorithms import Algorithm
from bgpo_trl.algorithms.algorithm import Policy, read_joints
from bgpo_trl.algorithms.environments import observation_env
from bgpo_trl.configs import AlgorithmConfig
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.encoders.representation import Representation
from bgpo_trl.scenes import Scene, find_scene
from bgpo_trl.seeding import stream_seed
from bgpo_trl.transforms import TaskSchedule


@dataclass(frozen=True)
class Snapshot:
    """Policy of a seed at one moment of its training, conditioned for one evaluation.

    Attributes:
        number: Number of earlier evaluations of this seed.
        episode: Number of earlier training episodes.
        env_steps: Number of earlier environment steps.
        presented: Tasks presented so far, bool ``[T]``.
        policy: The policy, conditioned on a demonstration of each test episode.
    """

    number: int
    episode: int
    env_steps: int
    presented: Tensor
    policy: Policy


@dataclass(frozen=True)
class TestResult:
    """Outcome of one evaluation of each seed ``S``: tasks ``T``, ``M`` test episodes each.

    Attributes:
        snapshots: The tested snapshots, one of each seed.
        success: Success, which is also the extrinsic return, bool ``[S, T, M]``.
        steps: Lengths of the episodes, int64 ``[S, T, M]``.
    """

    __test__ = False  # Keeps pytest from collecting it.

    snapshots: Sequence[Snapshot]
    success: Tensor
    steps: Tensor


class Evaluator:
    """Evaluation of all seeds as one batch.

    Seeds reach an evaluation at different times. Each leaves a `Snapshot`; once all have, their
    test episodes run side by side. Start states and demonstrations depend only on the seed and the
    number of the evaluation.

    Config, seeds, schedule and encoders are those of training; the bank has held-out
    demonstrations. ``spread`` is the share of the whole range of start states. Each task is tested
    in ``episodes`` episodes.

    Raises:
        ValueError: If a task has no demonstration.
    """

    def __init__(
        self,
        config: AlgorithmConfig,
        *,
        seeds: Sequence[int],
        schedule: TaskSchedule,
        episodes: int,
        bank: DemonstrationBank,
        encoders: Representation | None,
        spread: float = 1.0,
        scene: Scene | str = "nico",
    ) -> None:
        scene = find_scene(scene)
        self.max_steps = config.max_steps
        self._state_key = config.observed
        self.seeds, self.schedule = tuple(seeds), schedule
        n_tasks = schedule.n_tasks
        self.shape = (len(seeds), n_tasks, episodes)
        self._rows_of = [torch.nonzero(bank.task == task).flatten() for task in range(n_tasks)]
        missing = [task for task, rows in enumerate(self._rows_of) if not len(rows)]
        if missing:
            raise ValueError(
                f"the bank has no held-out demonstration of task {missing[0]}: hold some out of "
                "each task"
            )
        self._bank = bank
        self.simulation = scene.simulate(
            bank.tasks,
            batch_size=self.shape,
            spread=spread,
            observation="pixels" if config.state == "latent" else "state",
        )
        joints = read_joints(config, scene)
        self.env = observation_env(config, self.simulation, encoders, scene.state, joints)
        self._task = torch.arange(n_tasks)[:, None].expand(self.shape).contiguous()
        self._next = 0
        self._waiting: list[list[Snapshot]] = [[] for _ in seeds]

    def take(self, algorithm: Algorithm, index: int, episode: int, env_steps: int) -> None:
        """Queue a `snapshot` for the next evaluation of the seed at position ``index``."""
        number = self._next + len(self._waiting[index])
        snapshot = self.snapshot(algorithm, index, number, episode=episode, env_steps=env_steps)
        self._waiting[index].append(snapshot)

    def snapshot(
        self, algorithm: Algorithm, index: int, number: int, *, episode: int, env_steps: int = 0
    ) -> Snapshot:
        """Return a `Snapshot` of the seed at position ``index``.

        Raises:
            TypeError: If the algorithm returns no `Policy`, or one for other test episodes.
        """
        rng = _rng(self.seeds[index], number)
        drawn = torch.stack(
            [
                rows[torch.from_numpy(rng.integers(len(rows), size=self.shape[2]))]
                for rows in self._rows_of
            ]
        )
        generator = torch.Generator().manual_seed(int(rng.integers(2**63 - 1)))
        policy = algorithm.snapshot(
            index, self._bank.embedding[drawn], self._bank.task[drawn], generator
        )
        if not isinstance(policy, Policy):
            raise TypeError(
                f"snapshot of {type(algorithm).__name__} must return a Policy (self.policy(...)), "
                f"got {type(policy).__name__}"
            )
        for name, entry in (("network", policy.network), ("context", policy.context)):
            if entry is not None and entry.shape[:2] != drawn.shape:
                raise TypeError(
                    f"the {name} of a Policy of {type(algorithm).__name__} must be given for each "
                    f"test episode, {list(drawn.shape)}, got {list(entry.shape)}"
                )
        return Snapshot(
            number=number,
            episode=episode,
            env_steps=env_steps,
            presented=self.schedule.presented(torch.tensor(episode)),
            policy=policy,
        )

    def run_next(self, device: torch.device | str = "cpu") -> TestResult | None:
        """Run the next evaluation if all seeds have queued a snapshot."""
        if not all(self._waiting):
            return None
        self._next += 1
        return self.run([waiting.pop(0) for waiting in self._waiting], device)

    @torch.no_grad()
    def run(
        self,
        snapshots: Sequence[Snapshot],
        device: torch.device | str = "cpu",
        watch: Callable[[], object] = lambda: None,
    ) -> TestResult:
        """Play the test episodes of all tasks presented to each seed.

        Success and length are 0 for tasks not yet presented. ``device`` is that of the networks.
        ``watch`` is called at the start and after each step, for looking at `simulation`.
        """
        policies = [snapshot.policy.to(device) for snapshot in snapshots]
        starts = [
            start_seeds(seed, snapshot.number, self.shape[1:])
            for seed, snapshot in zip(self.seeds, snapshots, strict=True)
        ]
        self.simulation.seed_rows(np.stack(starts).ravel().tolist())
        presented = torch.stack([s.presented for s in snapshots])
        active = presented[:, :, None].expand(self.shape).clone()
        success, steps = torch.zeros(self.shape, dtype=torch.bool), torch.zeros(self.shape).long()
        # Episodes of tasks not yet presented do not begin, and are never drawn.
        start = {"task": self._task, "_reset": active.unsqueeze(-1)}
        state = self.env.reset(TensorDict(start, self.shape))
        watch()
        for _ in range(self.max_steps):
            seen = state[self._state_key].to(device)
            actions = [policy.act(of_seed) for policy, of_seed in zip(policies, seen, strict=True)]
            state.set("action", torch.stack(actions).cpu())
            state.set("_step", active)
            state = self.env.step(state)["next"]
            watch()
            steps += active
            success |= state["success"].squeeze(-1) & active
            active = active & ~state["done"].squeeze(-1)
            if not active.any():
                break
        return TestResult(snapshots, success, steps)

    def state_dict(self) -> dict[str, Any]:
        """Return the queue and the number of the next evaluation."""
        waiting = [
            [{**vars(snapshot), "policy": snapshot.policy.state_dict()} for snapshot in of_seed]
            for of_seed in self._waiting
        ]
        return {"next": self._next, "waiting": waiting}

    def load_state_dict(self, state: dict[str, Any], algorithm: Algorithm) -> None:
        """Restore a `state_dict`, given the algorithm of its snapshots.

        Snapshots of fewer tasks take the further ones as not yet presented.
        """
        self._next = state["next"]
        self._waiting = [
            [self._restored(saved, algorithm) for saved in of_seed] for of_seed in state["waiting"]
        ]

    def _restored(self, saved: dict[str, Any], algorithm: Algorithm) -> Snapshot:
        n_more = self.schedule.n_tasks - len(saved["presented"])

        def padded(entry: Tensor) -> Tensor:  # with the last task's, which are not used
            return torch.cat([entry, *[entry[-1:]] * n_more])

        policy = dict(saved["policy"])
        for name in ("context", "network"):
            if policy[name] is not None:
                policy[name] = padded(policy[name])
        presented = torch.cat([saved["presented"], torch.zeros(n_more, dtype=torch.bool)])
        return Snapshot(**{**saved, "presented": presented, "policy": algorithm.policy(**policy)})


class _Run(Protocol):
    """A `Trainer`, a `LoadedRun` or a `TrainedPolicy`."""

    config: Any
    encoders: Any
    algorithm: Any


def evaluator_of(
    run: _Run,
    bank: DemonstrationBank,
    episodes: int,
    *,
    starts: tuple[int, ...] | None = None,
    scene: Scene | None = None,
) -> Evaluator:
    """Return an evaluator of the tasks of a run, which shows demonstrations of ``bank``.

    Each task is tested from its start on, by default from 0; the robot is the run's by default.
    """
    config = run.config
    return Evaluator(
        config.algorithm,
        seeds=config.seeds,
        schedule=TaskSchedule((0,) * len(config.tasks) if starts is None else starts),
        episodes=episodes,
        bank=bank,
        encoders=run.encoders,
        spread=config.spread,
        scene=config.scene if scene is None else scene,
    )


def snapshots_of(run: _Run, evaluator: Evaluator, number: int) -> list[Snapshot]:
    """Return the trained policy of each seed, conditioned for evaluation ``number``."""
    return [
        evaluator.snapshot(run.algorithm, index, number, episode=run.config.episodes)
        for index in range(len(run.config.seeds))
    ]


def start_seeds(seed: int, number: int, shape: Sequence[int]) -> NDArray[np.int64]:
    """Return seeds of the starts of a seed's evaluation ``number``, of ``shape`` ``[T, M]``."""
    return _rng(seed, number).integers(2**32, size=tuple(shape))


def _rng(seed: int, number: int) -> np.random.Generator:
    return np.random.default_rng([stream_seed(seed, "evaluation"), number])


@torch.no_grad()
def evaluate_random_policy(
    *,
    tasks: Sequence[str],
    episodes: int,
    seed: int = 0,
    spread: float = 1.0,
    max_steps: int | None = None,
    scene: Scene | str = "nico",
) -> Tensor:
    """Return the success rate of uniformly random actions on each task, float32 ``[T]``.

    Episodes have ``max_steps``, by default those of the scene.
    """
    shape, scene = (len(tasks), episodes), find_scene(scene)
    max_steps = scene.max_steps if max_steps is None else max_steps
    env = scene.simulate(
        tasks,
        batch_size=shape,
        seed=stream_seed(seed, "random policy") // 2,
        spread=spread,
        observation="pixels" if scene.state is None else "state",
    )
    generator = torch.Generator().manual_seed(seed)
    task = torch.arange(len(tasks))[:, None].expand(shape).contiguous()
    state = env.reset(TensorDict({"task": task}, shape))
    for _ in range(max_steps):
        action = torch.rand(*shape, scene.action_size, generator=generator) * 2 - 1
        state = env.step(state.set("action", action))["next"]
    return state["success"].squeeze(-1).float().mean(-1)
