"""Test episodes: frozen weights, frozen GWR-B, no noise, held-out demonstrations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import Compose, TransformedEnv

from bgpo_trl.algorithms import Algorithm
from bgpo_trl.algorithms.algorithm import Policy
from bgpo_trl.algorithms.observation import bound, encode, observed_size
from bgpo_trl.configs import RunConfig
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

    Args:
        config: The run.
        bank: Demonstrations to show in tests.
        encoders: The run's encoders.
        episodes: Test episodes of each task and seed.
        starts: Episode from which each task is tested; by default 0.
        scene: Robot to test; that of the run by default.

    Raises:
        ValueError: If a task has no demonstration, or policies cannot observe the scene.
    """

    def __init__(
        self,
        config: RunConfig,
        bank: DemonstrationBank,
        encoders: Representation | None,
        *,
        episodes: int,
        starts: tuple[int, ...] | None = None,
        scene: Scene | None = None,
    ) -> None:
        scene = find_scene(config.scene if scene is None else scene)
        self.config, learner, n_tasks = config, config.algorithm, len(config.tasks)
        observed_size(learner, scene, encoders)  # refuses a scene that policies cannot observe
        self.schedule = TaskSchedule((0,) * n_tasks if starts is None else starts)
        self.shape = (len(config.seeds), n_tasks, episodes)
        self._rows_of = [torch.nonzero(bank.task == task).flatten() for task in range(n_tasks)]
        missing = [task for task, rows in enumerate(self._rows_of) if not len(rows)]
        if missing:
            task = config.tasks[missing[0]]
            raise ValueError(
                f"the bank has no held-out demonstration of {task!r} in the {config.held_out} "
                "half: hold two out of each task (held_out_per_task), as each half needs one, and "
                "embed them anew"
            )
        self._bank = bank
        self.simulation = scene.simulate(
            bank.tasks,
            batch_size=self.shape,
            spread=config.spread,
            observation="pixels" if learner.state == "latent" else "state",
        )
        joints = scene.joints if learner.joints else None
        observe = [encode(learner, encoders, scene.state), *bound(learner, joints)]
        self.env = TransformedEnv(self.simulation, Compose(observe))
        self._task = torch.arange(n_tasks)[:, None].expand(self.shape).contiguous()
        self._next = 0
        self._waiting: list[list[Snapshot]] = [[] for _ in config.seeds]

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
        rng = _rng(self.config.seeds[index], number)
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

    def snapshots(self, algorithm: Algorithm, number: int) -> list[Snapshot]:
        """Return the trained policy of each seed, conditioned for evaluation ``number``."""
        episode, n_seeds = self.config.episodes, len(self.config.seeds)
        return [self.snapshot(algorithm, i, number, episode=episode) for i in range(n_seeds)]

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
            for seed, snapshot in zip(self.config.seeds, snapshots, strict=True)
        ]
        self.simulation.seed_rows(np.stack(starts).ravel().tolist())
        presented = torch.stack([s.presented for s in snapshots])
        active = presented[:, :, None].expand(self.shape).clone()
        success, steps = torch.zeros(self.shape, dtype=torch.bool), torch.zeros(self.shape).long()
        # Episodes of tasks not yet presented do not begin, and are never drawn.
        start = {"task": self._task, "_reset": active.unsqueeze(-1)}
        state = self.env.reset(TensorDict(start, self.shape))
        watch()
        for _ in range(self.config.algorithm.max_steps):
            seen = state[self.config.algorithm.observed].to(device)
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
