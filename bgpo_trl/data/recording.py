"""Record demonstrations (frames, states, actions) as a dataset."""

from __future__ import annotations

import contextlib
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from operator import index
from pathlib import Path
from reprlib import repr as short_repr
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

from bgpo_trl.data.dataset import (
    META,
    NUMBERS,
    checksum_of,
    fill_row,
    layout_of,
    load_demonstrations,
    make_dataset,
    open_dataset,
    read_meta,
)
from bgpo_trl.files.progress import progress_bar
from bgpo_trl.files.writing import write_json
from bgpo_trl.scenes import Scene, Simulation, find_scene
from bgpo_trl.scenes.check import check_scene
from bgpo_trl.scenes.scene import checked_frame, checked_numbers, checked_step

_Policy = Callable[[], np.ndarray]


def record_demonstrations(
    path: str | Path,
    *,
    scene: Scene | str = "nico",
    tasks: Sequence[str] | None = None,
    per_task: int = 1_200,
    held_out_per_task: int = 200,
    play: bool = False,
    spread: float = 1.0,
    seed: int = 0,
    attempts: int = 100,
    progress: bool = True,
) -> TensorDict:
    """Record successful demonstrations of each task, or resume an interrupted recording.

    Row ``i`` depends on ``seed`` and ``i`` alone, so a resumed recording gives the same dataset.

    With ``play``, record play instead: follow a demonstration for up to three fifths of the longest
    episode, then act at random to its end. Trial and error visits states that no demonstration
    shows.

    Args:
        path: Folder of the dataset; made if missing.
        scene: The robot, or its name.
        tasks: Tasks to demonstrate, in the order of their labels; by default the scene's.
        per_task: Demonstrations of each task (1,200 in Sec. IV-B).
        held_out_per_task: How many of those are held out for test episodes.
        play: Record play instead of demonstrations.
        spread: Share of the whole range of start states.
        seed: Seed of the start states and of the demonstrator's noise.
        attempts: Consecutive failures of a demonstrator after which recording stops.
        progress: Whether to show a progress bar.

    Returns:
        A memory-mapped TensorDict ``[N]`` with ``pixels`` uint8 ``[N, T + 1, H, W, 3]``, ``state``
        ``[N, T + 1, F]`` if the scene has ground truth, ``joints`` ``[N, T + 1, J]`` if it has
        joints, ``action`` ``[N, T, A]``, ``length`` int64
        ``[N]`` (frames, one more than actions), ``task`` int64 ``[N]``, ``train`` bool ``[N]``
        (``False``: held out) and ``seed`` int64 ``[N]``; zero beyond the length.

    Raises:
        ValueError: If an argument is invalid, ``path`` holds another recording, the scene has no
            demonstrator or no `Simulation`, or `check_scene` finds it wrong; there is a warning for
            what it doubts.
        OSError: If there is not enough disk space.
        RuntimeError: If there is no OpenGL to render with, or a demonstrator fails too often;
            earlier rows are kept.
    """
    # NumPy's integers cannot be written as JSON; fractions are refused.
    per_task, held_out_per_task, seed = map(index, (per_task, held_out_per_task, seed))
    scene = find_scene(scene)
    tasks = scene.default_tasks if tasks is None else tasks
    scene.check_tasks(tasks)
    scene.check_spread(spread)
    if scene.demonstrator is None:
        raise ValueError(
            f"the scene {scene.name!r} has no demonstrator: write demonstrations that you have, "
            "with write_demonstrations (docs/extending.md)"
        )
    if not tasks:
        raise ValueError("name at least one of the tasks")
    if not 0 <= seed < 2**63 or attempts < 1:
        raise ValueError(
            f"seed must lie in 0..2**63 - 1 and attempts be at least 1, got {seed} and {attempts}"
        )
    if not 0 <= held_out_per_task < per_task:
        raise ValueError(
            f"held_out_per_task is {held_out_per_task}: it must be less than per_task, {per_task}"
        )
    wanted = {
        **layout_of(scene, NUMBERS, scene.max_steps),
        "tasks": list(tasks),
        "rows": per_task * len(tasks),
        "per_task": per_task,
        "held_out_per_task": held_out_per_task,
        "spread": float(spread),
        "seed": seed,
        **({"play": True} if play else {}),
    }
    path = Path(path)
    started = (path / META).exists()
    if started:
        meta = read_meta(path)
        found = {key: meta.get(key) for key in {**wanted, **meta} if key != "checksum"}
        if found != wanted:
            raise ValueError(
                f"{path} holds another recording ({found}); choose another folder or remove it"
            )
        if meta.get("checksum"):
            return load_demonstrations(path)
    # The renderer comes first, so that a machine without OpenGL fails before writing anything.
    for doubt in [] if started else check_scene(scene, tasks):
        warnings.warn(f"the scene {scene.name!r}: {doubt}", stacklevel=2)
    env = scene.simulate(tasks, batch_size=1, spread=spread)
    with contextlib.closing(env):
        if not hasattr(env, "simulations"):
            raise ValueError(
                f"demonstrators cannot act in the {type(env).__name__} of the scene "
                f"{scene.name!r}, which has no simulations: write demonstrations that you have, "
                "with write_demonstrations (docs/extending.md)"
            )
        dataset = open_dataset(path, wanted) if started else make_dataset(path, wanted)
        if not started:
            write_json(path / META, wanted)
        recorder = _Recorder(scene, env.simulations[0], seed, attempts)
        missing = torch.nonzero(dataset["length"] == 0).flatten().tolist()
        bar = progress_bar(
            "record play" if play else "record demonstrations",
            missing,
            shown=progress,
            total=len(dataset),
            initial=len(dataset) - len(missing),
            unit="episode",
        )
        for row in bar:
            task, number = divmod(int(row), per_task)
            record = recorder.play if play else recorder.demonstrate
            dataset["seed"][row] = seed
            train = number < per_task - held_out_per_task
            fill_row(dataset, row, record(tasks[task], row), task, train)
    for task, tried in recorder.tried.items():
        if 2 * (succeeded := recorder.succeeded[task]) < tried:
            warnings.warn(
                f"the demonstrator of {task!r} succeeded in {succeeded} of {tried} attempts: what "
                "is recorded are the starts that it can do",
                stacklevel=2,
            )
    write_json(path / META, {**wanted, "checksum": checksum_of(dataset)})
    return dataset


def new_demonstrations(**options: Any) -> TensorDict:
    """Return demonstrations as of `record_demonstrations`, in memory, of which none is held out.

    Args:
        **options: Arguments of `record_demonstrations`.
    """
    with tempfile.TemporaryDirectory() as folder:
        return record_demonstrations(folder, held_out_per_task=0, **options).to_tensordict()


class _Recorder:
    """Demonstrations and play in one simulation, each determined by its row."""

    def __init__(self, scene: Scene, simulation: Simulation, seed: int, attempts: int) -> None:
        self.scene, self.simulation = scene, simulation
        self.seed, self.attempts = seed, attempts
        self.tried, self.succeeded = Counter[str](), Counter[str]()

    def demonstrate(self, task: str, row: int) -> dict[str, np.ndarray]:
        """Return the first success; raise ``RuntimeError`` if too many attempts fail."""
        sequence = np.random.SeedSequence([self.seed, row])
        for _ in range(self.attempts):
            start, noise = (int(child.generate_state(1)[0]) for child in sequence.spawn(2))
            episode, success = perform(self.scene, self.simulation, task, start, noise)
            self.tried[task] += 1
            if success:
                self.succeeded[task] += 1
                return episode
        succeeded, tried = self.succeeded[task], self.tried[task]
        raise RuntimeError(
            f"the demonstrator of {task!r} failed {self.attempts} times in a row ({succeeded} of "
            f"{tried} attempts succeeded, {succeeded / tried:.0%}): fix it, or raise the "
            "attempts of record_demonstrations"
        )

    def play(self, task: str, row: int) -> dict[str, np.ndarray]:
        """Return an episode that follows a demonstration, then moves at random.

        The movement is jerky in some episodes and smooth in others.
        """
        rng, size = np.random.default_rng([self.seed, row, 1]), self.scene.action_size
        start, noise = (int(value) for value in rng.integers(2**32, size=2))
        n_followed = rng.integers(self.scene.max_steps * 3 // 5 + 1)
        persistence, spread = rng.uniform(0, 0.9), rng.uniform(0.2, 0.8)
        movement, steps = rng.standard_normal(size), 0

        def deviate(demonstrator: _Policy) -> _Policy:
            def act() -> np.ndarray:
                nonlocal movement, steps
                steps += 1
                if steps <= n_followed:
                    return demonstrator()
                jerk = (1 - persistence**2) ** 0.5 * rng.standard_normal(size)
                movement = persistence * movement + jerk
                return np.clip(spread * movement, -1.0, 1.0)

            return act

        return perform(self.scene, self.simulation, task, start, noise, deviate)[0]


def perform(
    scene: Scene,
    simulation: Simulation,
    task: str,
    start: int,
    noise: int,
    policy_of: Callable[[_Policy], _Policy] = lambda demonstrator: demonstrator,
) -> tuple[dict[str, np.ndarray], bool]:
    """Return an episode as for `write_demonstrations`, and whether it succeeded.

    ``start`` and ``noise`` are the seeds of simulation and demonstrator. ``policy_of`` returns the
    policy that acts, given the demonstrator's.

    Raises:
        ValueError: If an action is not ``[A]`` in [-1, 1], or the simulation returns what
            `Simulation` does not allow.
    """

    def observe() -> dict[str, np.ndarray]:
        moment: dict[str, np.ndarray] = {"pixels": checked_frame(simulation, scene.frame_shape)}
        if scene.state is not None:
            moment["state"] = checked_numbers(simulation, "state", scene.state.size)
        if scene.joints is not None:
            moment["joints"] = checked_numbers(simulation, "joints", scene.joints.size)
        return moment

    simulation.seed(start)
    simulation.reset(task)
    assert scene.demonstrator is not None
    act = policy_of(scene.demonstrator(simulation, task, noise))
    whose = f"an episode of the demonstrator of {task!r}"
    moments, actions, success = [observe()], [], False
    for _ in range(scene.max_steps):
        action = np.array(act(), np.float64)  # a copy, since a policy may use its array again
        # Every simulation would make something else of such an action.
        if action.shape != (scene.action_size,) or not np.isfinite(action).all():
            found = short_repr(action.tolist())
            raise ValueError(f"{whose} has the action {found}: give {scene.action_size}, finite")
        if (largest := np.float32(np.abs(action).max())) > 1:
            raise ValueError(f"{whose} has an action of size {largest!s}: scale actions to [-1, 1]")
        success, failure, executed = checked_step(simulation, action)
        actions.append(executed)
        moments.append(observe())
        if success or failure:
            break
    episode = {key: np.stack([moment[key] for moment in moments]) for key in moments[0]}
    return {**episode, "action": np.stack(actions)}, success
