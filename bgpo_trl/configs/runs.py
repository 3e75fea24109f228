"""Defaults of runs, and their presets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from tyro.conf import Fixed

from bgpo_trl.configs.algorithms import AlgorithmConfig, BGPOConfig, at_least, check
from bgpo_trl.configs.settings import Settings

PAPER_TASKS = ("grasp_glass", "push_green_to_glass", "push_green_to_white")
"""Names of the paper's tasks, in its order."""


def check_seeds(seeds: Sequence[int]) -> None:
    """Raise ``ValueError`` unless there are seeds, all different, and none is negative."""
    if not seeds or len(set(seeds)) < len(seeds) or min(seeds) < 0:
        raise ValueError(f"seeds must be one or more, all different and none negative: {seeds}")


@dataclass(frozen=True)
class RunConfig(Settings):
    """One run of an experiment: its seeds, length, tasks and schedule.

    All settings but those marked as fixed are flags of the command line. On these, others depend.
    """

    seeds: tuple[int, ...] = tuple(range(10))
    """Seeds, run as one batch (Sec. IV: 10)."""
    episodes: Fixed[int] = 20_000
    """Training episodes of each seed (Figs. 6 and 8)."""
    scene: Fixed[str] = "nico"
    """Name of the robot with its tasks in `bgpo_trl.scenes.SCENES`."""
    tasks: Fixed[tuple[str, ...]] = PAPER_TASKS
    """Names of the tasks, as in the scene and the CSV files; by default the paper's three."""
    task_starts: tuple[int, ...] = (0, 7_000, 13_000)
    """Episode from which each task is presented (Sec. IV-C); all 0 is the concurrent setting."""
    schedule: Literal["practised", "sequential"] = "practised"
    """Tasks that training episodes are drawn from: ``"practised"``, all presented so far;
    ``"sequential"``, only the newest, as in Continual World and COOM. Tests are of all presented so
    far in both."""
    spread: float = 1.0
    """Share of the suite's range of start states, from 0 (objects at their nominal places) to 1.
    Ours."""
    eval_every: int = 1
    """Training episodes between evaluations (1 in the paper)."""
    eval_episodes: int = 1
    """Test episodes per evaluation, of each task presented so far. Ours: the paper tests one
    episode of one random task, which is cheaper but noisier. 0 is for a physical robot: training
    without tests, by `Trainer` alone."""
    held_out: Literal["validation", "test"] = "validation"
    """Half of the held-out demonstrations that test episodes show: ``"validation"`` for choosing
    settings, ``"test"`` for reporting results. Ours."""
    demonstrations: int = 0
    """Demonstrations of each task that training episodes show, the first of the bank; 0 for all of
    them. Ours."""
    offline_updates: int = 0
    """Updates of each seed from the demonstrations of the first tasks alone, before its first
    episode. Ours."""
    checkpoint_minutes: float = 10.0
    """Minutes between checkpoints. Ours."""
    name: Fixed[str] = "bgpo"
    """Name of the algorithm or variant, as in the CSV files."""
    algorithm: AlgorithmConfig = field(default_factory=BGPOConfig)
    """The algorithm's hyperparameters."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_seeds(self.seeds)
        at_least(self, 1, "episodes", "eval_every")
        at_least(self, 0, "checkpoint_minutes")
        at_least(self, 0, "demonstrations", "eval_episodes", "offline_updates")
        distinct = len(set(self.tasks)) == len(self.tasks)
        starts, learner = self.task_starts, self.algorithm
        from_shown = isinstance(learner, BGPOConfig) and learner.demonstration_share > 0
        check(
            self,
            (
                "offline_updates",
                from_shown or not self.offline_updates,
                "0 for MAML, Dist-NLL and algorithms without demonstrations as experience",
            ),
            ("tasks", distinct, "names of different tasks"),
            ("spread", 0.0 <= self.spread <= 1.0, "from 0 (nominal places) to 1"),
            ("task_starts", len(starts) == len(self.tasks), "one episode for each of the tasks"),
            ("task_starts", min(starts, default=-1) == 0, "at least 0, and one of them 0"),
        )


PRESETS: dict[str, RunConfig] = {
    "smoke": RunConfig(
        seeds=(0, 1), episodes=12, task_starts=(0, 4, 8), eval_every=6, eval_episodes=1
    ),
    "quick": RunConfig(
        seeds=(0, 1), episodes=1_800, task_starts=(0, 570, 1_050), eval_every=150, eval_episodes=10
    ),
    "desk": RunConfig(
        seeds=(0, 1, 2, 3, 4),
        episodes=6_000,
        task_starts=(0, 2_100, 3_900),
        eval_every=100,
        eval_episodes=5,
    ),
    "paper": RunConfig(),
}
"""Runs by ``--preset``: ``smoke`` passes every stage in minutes, ``quick`` shows learning, ``desk``
is five seeds in three hours, ``paper`` is the paper's scale."""
