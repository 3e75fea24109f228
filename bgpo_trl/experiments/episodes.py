"""Test episodes of finished runs."""

from __future__ import annotations

from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.evaluation import Evaluator, Snapshot
from bgpo_trl.policy import LoadedRun, TrainedPolicy
from bgpo_trl.scenes import Scene
from bgpo_trl.training import Trainer
from bgpo_trl.transforms import TaskSchedule


def evaluator_of(
    run: LoadedRun | Trainer | TrainedPolicy,
    bank: DemonstrationBank,
    episodes: int,
    *,
    starts: tuple[int, ...] | None = None,
    scene: Scene | None = None,
) -> Evaluator:
    """Return an evaluator of the tasks of a run.

    Args:
        run: The run.
        bank: Demonstrations to show.
        episodes: Test episodes of each task and seed.
        starts: Episode from which each task is presented; by default all are.
        scene: Robot to test, that of the run if None.
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


def snapshots_of(run: LoadedRun | Trainer, evaluator: Evaluator, number: int) -> list[Snapshot]:
    """Return the trained policy of each seed, conditioned for evaluation ``number``."""
    return [
        evaluator.snapshot(run.algorithm, index, number, episode=run.config.episodes)
        for index in range(len(run.config.seeds))
    ]
