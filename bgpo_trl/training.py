"""The training loop: step all seeds, learn, test, log, save; continue what was interrupted."""

from __future__ import annotations

import gc
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

import torch
from tensordict import TensorDict, TensorDictBase

from bgpo_trl.algorithms import Algorithm, entry
from bgpo_trl.configs import RunConfig
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.encoders.representation import Representation
from bgpo_trl.evaluation import Evaluator
from bgpo_trl.files.checkpoint import save_checkpoint
from bgpo_trl.files.interrupts import interrupts_wait
from bgpo_trl.files.locking import DirectoryLock
from bgpo_trl.files.progress import progress_bar
from bgpo_trl.runs.config_file import settings_of
from bgpo_trl.runs.directory import load_last
from bgpo_trl.runs.gwr_graphs import growth_moments, save_graph
from bgpo_trl.runs.logger import RunLogger
from bgpo_trl.transforms import TaskSchedule
from bgpo_trl.world import World


class Trainer:
    """One run: an algorithm, its test episodes, its files.

    Each seed of the batch plays ``config.episodes`` training episodes. Seeds that are done early go
    on, unlogged, until the last one is; everything that is logged is what the seed alone would have
    logged, but for the losses, which are means over the seeds. A run may be resumed with more
    ``config.episodes`` than it had: it is then what the longer run would have been.

    Each update runs while the environment takes a step, and learns from all transitions before it.

    Checkpoints are written between steps only, and an interrupt (Ctrl-C) waits for the end of its
    step, so that each checkpoint is a state that the run has been in. Whatever else ends a run
    costs it what came after its last checkpoint, and no row: a resumed run writes them again. The
    first one is written before the first step.

    Rows are in their files at once. Mirrors such as Weights & Biases hear that it is over when the
    trainer is closed, so that figures can still reach them after `run`: use it in a ``with`` block.
    Until then no other process can write to the directory.

    Args:
        config: The run.
        directory: The run's directory: ``config.json``, ``train.csv``, ``eval.csv``,
            ``checkpoint/``, and in ``gwr/`` the graph of the first seed's GWR-B at some moments.
        bank: Embedded demonstrations, seen and held out; those of ``config.tasks`` are used.
        encoders: Trained encoders; None for a run that does not use them.
        make: Makes the algorithm; by default the entry of ``config.name``.
        device: Where the networks are; see `Algorithm`.
        resume: Continue the run in the directory, from its last checkpoint; begin it where there is
            none.
        wandb: None, ``"online"`` or ``"offline"``: mirror the CSV there.
        progress: Whether to show a progress bar.

    Raises:
        ValueError: If the directory holds another run (other settings, other encoders), or one and
            ``resume`` is False; if rows, checkpoint or ``config.json`` of a run to continue are
            missing; or if the bank has no demonstration of one of the tasks.
        BlockingIOError: If another process is at work in the directory.
    """

    def __init__(
        self,
        config: RunConfig,
        directory: str | Path,
        *,
        bank: DemonstrationBank,
        encoders: Representation | None = None,
        make: Callable[..., Algorithm] | None = None,
        device: torch.device | str = "cpu",
        resume: bool = False,
        wandb: Literal["online", "offline"] | None = None,
        progress: bool = True,
    ) -> None:
        self.config = config
        self.directory = Path(directory)
        self.progress = progress
        self.encoders = encoders
        bank = bank.for_tasks(config.tasks)
        schedule = TaskSchedule(starts=config.task_starts)
        seeds = config.seeds
        make = entry(config.name).make if make is None else make
        self.algorithm = make(
            config.algorithm, seeds=seeds, bank=bank.seen(), encoders=encoders, device=device
        )
        self.world = World(self.algorithm, seeds=seeds, schedule=schedule, bank=bank.seen())
        self.evaluator = Evaluator(
            config.algorithm,
            seeds=seeds,
            schedule=schedule,
            episodes=config.eval_episodes,
            bank=bank.held_out(config.held_out),
            encoders=encoders,
        )
        self.env_steps = 0
        # For the progress bar: the latest episodes, and the latest test.
        self._successes: deque[int] = deque(maxlen=100)
        self._tested = ""
        self._growth_moments = growth_moments(config.episodes)
        # Rows of seeds that were done early and went on.
        self._later: list[dict[str, Any]] = []
        encoders_used = None if encoders is None else encoders.identity
        self._settings = settings_of(config, encoders_used)
        self._state: TensorDictBase | None = None
        self._lock = DirectoryLock(self.directory)
        try:
            saved = load_last(self.directory, self._settings) if resume else None
            if saved is not None:
                self._load(saved)
            self.logger = RunLogger(
                self.directory, config=self._settings, wandb=wandb, resume=resume
            )
            if saved is not None:
                self.logger.truncate_to(saved["position"])
                for row in saved.get("later", []):
                    self._log(row)
        except BaseException:
            self._lock.release()
            raise

    def run(self) -> None:
        """Train to the end; does nothing where a resumed run is there already.

        Raises:
            KeyboardInterrupt: At the first Ctrl-C, when the step is over and saved; at a second one
                at once.
            OSError: If the disk is full.
        """
        algorithm, env, n_episodes = self.algorithm, self.world.env, self.config.episodes
        if self._state is None:
            self._state = env.reset()
            self.save()  # So that there are never rows without a checkpoint.
        state, saved = self._state, time.monotonic()
        episodes = self.world.source.episode  # counted in place by each reset
        bar = progress_bar(
            "train",
            shown=self.progress,
            total=n_episodes * len(self.config.seeds),
            initial=int(episodes.clamp(max=n_episodes).sum()),
            unit="episode",
        )
        losses: dict[str, torch.Tensor] = {}
        # What is here now stays to the end: the garbage collector need not look at it again.
        gc.freeze()
        try:
            with interrupts_wait() as interrupted, ThreadPoolExecutor(1, "update") as background:
                while int(episodes.min()) < n_episodes:
                    before = episodes.clone()
                    state = algorithm.act(state)
                    update = background.submit(algorithm.update)
                    transition, state = env.step_and_maybe_reset(state)
                    losses = update.result() or losses
                    algorithm.store(transition)
                    self.env_steps += 1
                    self._state = state
                    for index in torch.nonzero(episodes > before).flatten().tolist():
                        self._end_of_episode(index, transition, losses)
                        if before[index] < n_episodes:
                            bar.set_postfix_str(self._success_so_far(), refresh=False)
                            bar.update()
                    self._evaluate()
                    due = time.monotonic() - saved > 60 * self.config.checkpoint_minutes
                    stop = interrupted()
                    if due or stop or int(episodes.min()) >= n_episodes:
                        self.save()
                        saved = time.monotonic()
                    if stop:
                        break
        finally:
            gc.unfreeze()
            bar.close()

    def close(self) -> None:
        """Close the run's files and mirrors, and lets other processes into its directory."""
        self.logger.close()
        self._lock.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc_value: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _success_so_far(self) -> str:
        rate = sum(self._successes) / len(self._successes)
        return f"success {rate:.2f}{self._tested}"

    def _end_of_episode(
        self, index: int, transition: TensorDictBase, losses: dict[str, torch.Tensor]
    ) -> None:
        algorithm, end = self.algorithm, transition.get("next")[index]
        episode = int(self.world.source.episode[index])
        intrinsic = end.get("episode_intrinsic_reward", 0.0)  # not measured in every variant
        extrinsic = end.get("episode_extrinsic_reward", end["episode_reward"])
        nodes = 0 if algorithm.gwr is None else int(algorithm.gwr.num_nodes[index])
        groups = 1 if algorithm.groups is None else int(algorithm.groups.num_groups[index])
        row = {
            "algorithm": self.config.name,
            "seed": self.config.seeds[index],
            "episode": episode,
            "env_steps": self.env_steps,
            "task": self.config.tasks[int(end["task"])],
            "success": int(end["terminated"]),
            "return": float(extrinsic),
            "steps": int(end["step_count"]),
            "intrinsic_return": float(intrinsic),
            "num_nodes": nodes,
            "group": int(end.get("group", 0)),
            "num_groups": groups,
            "loss_actor": float(losses.get("loss_actor", 0.0)),
            "loss_value": float(losses.get("loss_value", 0.0)),
        }
        self._log(row)
        if index == 0 and algorithm.gwr is not None and episode in self._growth_moments:
            save_graph(self.directory / "gwr", episode, algorithm.gwr)
        if episode % self.config.eval_every == 0:
            self.evaluator.take(algorithm, index, episode, self.env_steps)

    def _log(self, row: dict[str, Any]) -> None:
        """Log an episode, or keeps what only a longer run would log."""
        if row["episode"] <= self.config.episodes:
            self._successes.append(row["success"])
            self.logger.log_train(row)
        else:
            self._later.append(row)

    def _evaluate(self) -> None:
        while (result := self.evaluator.run_next(self.algorithm.device)) is not None:
            for index, snapshot in enumerate(result.snapshots):
                for task in torch.nonzero(snapshot.presented).flatten().tolist():
                    for success, steps in zip(
                        result.success[index, task].tolist(),
                        result.steps[index, task].tolist(),
                        strict=True,
                    ):
                        self.logger.log_eval(
                            {
                                "algorithm": self.config.name,
                                "seed": self.config.seeds[index],
                                "episode": snapshot.episode,
                                "env_steps": snapshot.env_steps,
                                "task": self.config.tasks[task],
                                "success": int(success),
                                "return": float(success),
                                "steps": steps,
                            }
                        )
            shown = result.success.float().mean((0, 2)).tolist()
            self._tested = ", in tests " + " ".join(f"{rate:.2f}" for rate in shown)

    def save(self) -> None:
        """Write a checkpoint from which `resume` continues to the same curve."""
        assert self._state is not None
        state: dict[str, Any] = {
            "algorithm": self.algorithm.state_dict(),
            "world": self.world.state_dict(),
            "evaluator": self.evaluator.state_dict(),
            "state": self._state.clone().to_dict(),
            "env_steps": self.env_steps,
            "later": self._later,
            "settings": self._settings,
            "position": self.logger.position(),
        }
        save_checkpoint(self.directory / "checkpoint", state)

    def _load(self, state: dict[str, Any]) -> None:
        self.world.load_state_dict(state["world"])
        self.algorithm.load_state_dict(state["algorithm"])
        self.evaluator.load_state_dict(state["evaluator"], self.algorithm)
        self._state = TensorDict(state["state"], self.world.env.batch_size)
        self.env_steps = state["env_steps"]
