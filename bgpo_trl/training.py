"""The training loop: step all seeds, update, evaluate, log and save; resume an interrupted run."""

from __future__ import annotations

import gc
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.record.loggers.common import Logger

from bgpo_trl.algorithms import Algorithm, entry
from bgpo_trl.algorithms.bgpo import BGPO
from bgpo_trl.configs import RunConfig
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.encoders.mismatch import doubt_frames
from bgpo_trl.encoders.representation import Representation, check_savable
from bgpo_trl.evaluation import Evaluator
from bgpo_trl.files.checkpoint import save_checkpoint
from bgpo_trl.files.progress import progress_bar
from bgpo_trl.files.writing import lock_directory
from bgpo_trl.interrupts import interrupts_wait
from bgpo_trl.logged import LoggedEpisodes, replay_logged
from bgpo_trl.runs.config_file import Digests, settings_of
from bgpo_trl.runs.cost import CostLog
from bgpo_trl.runs.dashboard import Dashboard
from bgpo_trl.runs.demonstrations import keep_inputs
from bgpo_trl.runs.directory import (
    digest_of_logged,
    fitting_checkpoint,
    load_last,
    open_tables,
    put_back_costs,
    replacing_costs,
)
from bgpo_trl.runs.provenance import command, commit_of_code
from bgpo_trl.scenes import find_scene
from bgpo_trl.seeding import generators
from bgpo_trl.transforms import TaskSchedule
from bgpo_trl.world import World


class Trainer:
    """One run: an algorithm, its evaluations and its files.

    Each seed of the batch plays ``config.episodes`` training episodes. Seeds that finish early go
    on, unlogged, until the last one finishes; logged values are those of the seed alone. A run
    resumed with more ``config.episodes`` equals a run of that length. A run resumed with further
    tasks at the end (`bgpo_trl.runs.growth.add_task`) keeps all that it has learned.

    With ``logged``, the replay of each seed first gets these episodes (`replay_logged`). With
    ``config.offline_updates``, it then learns from them and from the demonstrations of the tasks
    that are presented from the start (`BGPO.learn_offline`). A run that is interrupted meanwhile
    begins again when it is resumed.

    Updates, one in ``update_every`` steps, run while the environment steps, and learn from all
    earlier transitions.

    Checkpoints are written before the first step and between steps; Ctrl-C and SIGTERM wait for the
    end of the step and save. After any other failure, a resumed run repeats the steps since the
    last checkpoint and writes the same rows. Rows are written at once; dashboards stay open for
    final tests and figures until `close`, which also unlocks the directory. Use the trainer in a
    ``with`` block.

    Args:
        config: The run.
        directory: The run's directory: ``config.json``, ``train.csv``, ``eval.csv``, ``cost.csv``,
            ``checkpoint/``, and ``bank.safetensors`` and ``encoders/`` if these do not come with
            the scene.
        bank: Embedded demonstrations, seen and held out, of at least ``config.tasks``.
        encoders: Trained encoders, or None if unused.
        make: Constructor of the algorithm; by default that of the entry ``config.name``.
        device: Device of the networks; see `Algorithm`.
        logged: Folder of logged episodes (`write_logged_episodes`). A run to be resumed that has a
            checkpoint has learned them, and needs them no more.
        resume: Continue from the last checkpoint in the directory, if there is one.
        loggers: TorchRL's loggers, or functions without arguments that make one, called once the
            directory is accepted. They get the means that `Dashboard` lists.
        progress: Whether to show a progress bar.

    Raises:
        ValueError: If the directory holds a run with other settings, encoders, demonstrations or
            logged episodes, of another version of the scene, or any run and ``resume`` is False; if
            rows, checkpoint or ``config.json`` of a run to resume are missing; if the bank has no
            demonstration of a task, or is not of the encoders; if the run cannot learn from the
            logged episodes.
        BlockingIOError: If another process works in the directory.
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
        logged: str | Path | None = None,
        resume: bool = False,
        loggers: Iterable[Logger | Callable[[], Logger]] = (),
        progress: bool = True,
    ) -> None:
        self.config = config
        self.directory = Path(directory)
        self.progress = progress
        self.encoders = encoders
        used = None if encoders is None else encoders.identity
        if None not in (used, bank.encoder_id) and used != bank.encoder_id:
            raise ValueError(
                f"the bank was embedded by the encoders {str(bank.encoder_id)[:12]}, these are "
                f"{str(used)[:12]}: load both together (load_pretrained), or embed anew "
                "(`bgpo bank`)"
            )
        self._scene = find_scene(config.scene)
        self._scene.check_tasks(config.tasks)
        if config.algorithm.max_steps > self._scene.max_steps:
            raise ValueError(
                f"the algorithm's max_steps is {config.algorithm.max_steps}, episodes of the scene "
                f"{self._scene.name!r} have at most {self._scene.max_steps}: set it to that"
            )
        remedy = "record demonstrations of this scene, train encoders on them and embed them"
        if bank.scene is not None:
            self._scene.check_identity(bank.scene, "the bank", remedy)
        if encoders is not None:
            encoders.check_scene(self._scene, "the file of the encoders", remedy)
            check_savable(encoders)  # The run could not be loaded.
        if bank.spread < config.spread:
            raise ValueError(
                f"the bank was recorded at spread {bank.spread}, the run is at {config.spread}: "
                "lower the run's spread, or record at a larger one"
            )
        bank = bank.for_tasks(config.tasks)
        self._logged = None if logged is None else LoggedEpisodes.load(logged)
        if self._logged is not None:
            self._logged.check(config, self._scene)
            learned = self._logged.identity
        else:
            learned = digest_of_logged(self.directory) if resume else None
        self.env_steps = 0
        # For the progress bar: the latest training episodes, and the latest evaluation.
        self._successes: deque[int] = deque(maxlen=100)
        self._tested = ""
        # Rows of seeds that finished early, kept for a resumed run with more episodes.
        self._later: list[dict[str, Any]] = []
        # Code and command lines that have trained what the checkpoint holds, and this one.
        self.starts = [{"commit": commit_of_code(), "command": command()}]
        self._settings = settings_of(config, Digests(used, bank.identity, learned))
        self._state: TensorDictBase | None = None
        self._losses: dict[str, torch.Tensor] = {}
        with ExitStack() as opened:
            opened.enter_context(lock_directory(self.directory))
            # Before anything is made of the sizes in the settings, which may not be the run's.
            saved = load_last(self.directory, self._settings) if resume else None
            self._make_parts(bank, make, device)
            if saved is not None:
                self._check_added_tasks(saved, bank)
                self.world.check_state(saved.get("world", {}))
                with fitting_checkpoint(self.directory):
                    self._load(saved)
                if encoders is not None:  # before config.json names tasks that may be added
                    keep_inputs(self.directory, bank, encoders, self._scene)
            if saved is not None:
                put_back_costs(self.directory, self.env_steps)
            self._cost = CostLog(self.directory / "cost.csv", resume=saved is not None)
            self.tables = opened.enter_context(
                open_tables(
                    self.directory,
                    config=self._settings,
                    logged=self.algorithm.logged,
                    position=saved["position"] if saved is not None else {} if resume else None,
                )
            )
            # Runs without encoders cannot be loaded to watch demonstrations.
            if saved is None and encoders is not None:
                keep_inputs(self.directory, bank, encoders, self._scene)
            self.dashboard = Dashboard(self.directory, loggers, settings=self._settings)
            opened.callback(self.dashboard.close)
            for row in () if saved is None else saved["later"]:
                self._log(row)
            self._opened = opened.pop_all()

    def _make_parts(
        self,
        bank: DemonstrationBank,
        make: Callable[..., Algorithm] | None,
        device: torch.device | str,
    ) -> None:
        config = self.config
        seen = bank.seen(config.demonstrations)
        self._schedule = TaskSchedule(config.task_starts, cumulative=config.schedule == "practised")
        make = entry(config.name).make if make is None else make
        self.algorithm = make(
            config.algorithm,
            seeds=config.seeds,
            bank=seen,
            encoders=self.encoders,
            device=device,
            scene=self._scene,
        )
        self.world = World(self.algorithm, schedule=self._schedule, spread=config.spread)
        self.evaluator: Evaluator | None = None
        if config.eval_episodes:
            tested = bank.held_out(config.held_out)
            self.evaluator = Evaluator(
                config,
                tested,
                self.encoders,
                episodes=config.eval_episodes,
                starts=config.task_starts,
            )

    def _check_added_tasks(self, saved: dict[str, Any], bank: DemonstrationBank) -> None:
        """Raise ``ValueError`` if tasks that a checkpoint lacks would change what was learned."""
        config, before = self.config, saved["settings"]
        n_before = len(before["tasks"])
        if n_before == len(config.tasks):
            return
        if not self.algorithm.takes_new_tasks:
            raise ValueError(
                f"{config.name} was made for {n_before} tasks and cannot take another one: begin a "
                "new run with all of the tasks"
            )
        known = bank.for_tasks(config.tasks[:n_before])
        if known.identity != before["bank"] or (bank.task[: len(known.task)] >= n_before).any():
            raise ValueError(
                f"the demonstrations of the {n_before} tasks of {self.directory} must stay the "
                "same and come first in the bank: add tasks with add_task (bgpo_trl.runs.growth)"
            )
        begun = int(saved["world"]["source"]["episode"].max())
        if min(config.task_starts[n_before:]) <= begun:
            raise ValueError(
                f"a seed of {self.directory} has begun episode {begun + 1} without the new task: "
                f"let it start at {begun + 1} or later"
            )

    def _compare_frames(self) -> None:
        """Warn if the simulation's frames seem unlike those that the encoders were trained on."""
        if self.encoders is not None and self.config.algorithm.state == "latent":
            frames = torch.from_numpy(self.world.simulation.frames())
            if doubt := doubt_frames(self.encoders.frame_network, frames):
                warnings.warn(f"the simulation's {doubt}", stacklevel=3)

    def run(self) -> None:
        """Train to the end; return at once if a resumed run is complete.

        Raises:
            KeyboardInterrupt: At the first Ctrl-C or SIGTERM after the step is over and saved, at a
                second one immediately.
            OSError: If the disk is full.
            TypeError: If the algorithm returns no action, or no `Policy` for a test.
        """
        algorithm, env, n_episodes = self.algorithm, self.world.env, self.config.episodes
        if self._state is None:
            if self._logged is not None:
                replay_logged(self.algorithm, self._logged, progress=self.progress)
            if self.config.offline_updates:
                self._learn_offline()
            self._state = env.reset()
            if self.world.state_dict()["simulation"] is None:
                warnings.warn(
                    f"simulations of the scene {self._scene.name!r} cannot be saved: if it is "
                    "interrupted, this run cannot be resumed (define save and load)",
                    stacklevel=2,
                )
            self._compare_frames()
            self.save()  # Rows without a checkpoint could not be resumed.
        state, saved = self._state, time.monotonic()
        episodes = self.world.source.episode  # updated in place
        bar = progress_bar(
            "train",
            shown=self.progress,
            total=n_episodes * len(self.config.seeds),
            initial=int(episodes.clamp(max=n_episodes).sum()),
            unit="episode",
        )
        n_tasks = self._n_tasks
        # Spares the garbage collector all objects that live until the end.
        gc.freeze()
        try:
            with interrupts_wait() as interrupted, ThreadPoolExecutor(1, "update") as background:
                while int(episodes.min()) < n_episodes:
                    before, started = episodes.clone(), time.monotonic()
                    state = self._act(state)
                    due = self.env_steps % self.config.algorithm.rl.update_every == 0
                    update = background.submit(algorithm.update) if due else None
                    transition, state = env.step_and_maybe_reset(state)
                    # Some losses are of every other update; rows have the latest of each.
                    self._losses |= update.result() if update else {}
                    algorithm.store(_executed(transition))
                    self._cost.add_step(n_tasks, time.monotonic() - started)
                    self.env_steps += 1
                    self._state = state
                    if self._n_tasks > n_tasks:
                        self._cost.measure(n_tasks, algorithm.state_dict())
                        n_tasks = self._n_tasks
                    for index in torch.nonzero(episodes > before).flatten().tolist():
                        self._end_of_episode(index, transition)
                        self._begin_tasks(index)
                        if before[index] < n_episodes:
                            rate = sum(self._successes) / len(self._successes)
                            bar.set_postfix_str(f"success {rate:.2f}{self._tested}", refresh=False)
                            bar.update()
                    self._evaluate()
                    late = time.monotonic() - saved > 60 * self.config.checkpoint_minutes
                    stop = interrupted()
                    if late or stop or int(episodes.min()) >= n_episodes:
                        self.save()
                        saved = time.monotonic()
                    if stop:
                        break
        finally:
            gc.unfreeze()
            bar.close()

    def _learn_offline(self) -> None:
        """Learn from all demonstrations of the first tasks, in an order of each seed's own."""
        config, algorithm = self.config, cast(BGPO, self.algorithm)
        presented = self._schedule.presented(torch.tensor(1))
        rows = presented[algorithm.bank.task].nonzero().flatten()
        streams = generators(config.seeds, "offline")
        orders = [rows[torch.randperm(len(rows), generator=stream)] for stream in streams]
        bar = progress_bar(
            "offline", shown=self.progress, total=config.offline_updates, unit="update"
        )
        for losses in algorithm.learn_offline(torch.stack(orders, 1), config.offline_updates):
            self._losses |= losses
            bar.update()
        bar.close()

    def close(self) -> None:
        """Close files and dashboards, and unlock the directory for other processes."""
        self._opened.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _act(self, state: TensorDictBase) -> TensorDictBase:
        acted = self.algorithm.act(state)
        if not isinstance(acted, TensorDictBase) or "action" not in acted:
            raise TypeError(
                f"act of {type(self.algorithm).__name__} must return the tensordict with an "
                f"action, got {type(acted).__name__}"
            )
        return acted

    @property
    def _n_tasks(self) -> int:
        """Number of tasks that are presented to all seeds."""
        return int(self._schedule.presented(self.world.source.episode + 1).sum(-1).min())

    def _end_of_episode(self, index: int, transition: TensorDictBase) -> None:
        algorithm, end = self.algorithm, transition.get("next")[index]
        episode = int(self.world.source.episode[index])
        intrinsic = end.get("episode_intrinsic_reward", 0.0)  # not measured in every variant
        pays = "episode_extrinsic_reward" in end
        extrinsic = end["episode_extrinsic_reward" if pays else "episode_reward"]
        task = self.config.tasks[int(end["task"])]
        # Demonstrations that are replayed pay 1 at their end, too.
        if self.config.algorithm.rl.clip_targets and not 0 <= float(extrinsic) <= 1:
            raise ValueError(
                f"an episode of {task} has a return of {float(extrinsic):.4g}, but values are "
                "clipped to those of a reward of 1 on success and 0 before: give this reward, or "
                "set rl.clip_targets to False"
            )
        nodes = 0 if algorithm.gwr is None else int(algorithm.gwr.num_nodes[index])
        groups = len(algorithm.groups[index].numbers) if algorithm.groups else 1
        row = {
            "algorithm": self.config.name,
            "seed": self.config.seeds[index],
            "episode": episode,
            "env_steps": self.env_steps,
            "task": task,
            "success": int(end["success"]),
            "return": float(extrinsic),
            "steps": int(end["step_count"]),
            "intrinsic_return": float(intrinsic),
            "num_nodes": nodes,
            "group": int(end.get("group", 0)),
            "num_groups": groups,
        }
        for name in ("loss_actor", "loss_value", *algorithm.logged):
            loss = self._losses.get(name, torch.zeros(()))
            row[name] = float(loss[index] if loss.ndim else loss)
        self._log(row)
        if self.evaluator is not None and episode % self.config.eval_every == 0:
            self.evaluator.take(algorithm, index, episode, self.env_steps)

    def _begin_tasks(self, index: int) -> None:
        """Announce the tasks that a seed's next episode is the first to present."""
        episode = self.world.source.episode[index]
        new = self._schedule.presented(episode + 1) & ~self._schedule.presented(episode)
        for task in torch.nonzero(new).flatten().tolist():
            self.algorithm.begin_task(index, task)

    def _log(self, row: dict[str, Any]) -> None:
        """Log an episode, or keep it if only a longer run would log it."""
        if row["episode"] <= self.config.episodes:
            self._successes.append(row["success"])
            self.tables["train.csv"].write(row)
            self.dashboard.log_train(row)
        else:
            self._later.append(row)

    def _evaluate(self) -> None:
        evaluator, device = self.evaluator, self.algorithm.device
        while evaluator is not None and (result := evaluator.run_next(device)) is not None:
            rows = [
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
                for index, snapshot in enumerate(result.snapshots)
                for task in torch.nonzero(snapshot.presented).flatten().tolist()
                for success, steps in zip(
                    result.success[index, task].tolist(),
                    result.steps[index, task].tolist(),
                    strict=True,
                )
            ]
            for row in rows:
                self.tables["eval.csv"].write(row)
            self.dashboard.log_eval(rows)
            presented = torch.stack([snapshot.presented for snapshot in result.snapshots])
            shown = (result.success.float().mean(2).sum(0) / presented.sum(0)).tolist()
            rates = ("-" if rate != rate else f"{rate:.2f}" for rate in shown)
            self._tested = f", in tests {' '.join(rates)}"

    def save(self) -> None:
        """Write a checkpoint, from which a resumed run continues identically."""
        assert self._state is not None
        state: dict[str, Any] = {
            "algorithm": self.algorithm.state_dict(),
            "world": self.world.state_dict(),
            "evaluator": {} if self.evaluator is None else self.evaluator.state_dict(),
            "state": self._state.clone().to_dict(),
            "env_steps": self.env_steps,
            "losses": self._losses,
            "later": self._later,
            "starts": self.starts,
            "settings": self._settings,
            "position": {name: table.position() for name, table in self.tables.items()},
        }
        self._cost.measure(self._n_tasks, state["algorithm"])
        with replacing_costs(self.directory):
            self._cost.write()
            save_checkpoint(self.directory / "checkpoint", state)

    def _load(self, state: dict[str, Any]) -> None:
        self.world.load_state_dict(state["world"])
        self.algorithm.load_state_dict(state["algorithm"])
        if self.evaluator is not None:
            self.evaluator.load_state_dict(state["evaluator"], self.algorithm)
        self._state = TensorDict(state["state"], self.world.env.batch_size)
        self.env_steps, self._losses = state["env_steps"], state["losses"]
        self.starts = [*state["starts"], *(x for x in self.starts if x not in state["starts"])]


def _executed(transition: TensorDictBase) -> TensorDictBase:
    """Return a transition with the action that a physical robot executed, see `RobotEnv`."""
    action = transition.get(("next", "executed_action"), None)
    return transition if action is None else transition.copy().set("action", action)
