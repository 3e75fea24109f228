"""The test of looking: success of a trained policy that is not shown where the objects are.

    python benchmarks/studies/looking.py runs/continual-bgpo-quick

A policy that has learned one movement for all starts succeeds without looking. The simulation is
always the true one; what is altered is the picture of it that the policy gets.
"""

# MuJoCo's bindings come without stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal, NamedTuple

import mujoco
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray
from shared import (
    TrainedArguments,
    load_blocks,
    play,
    random_actions,
    style_success,
    write_measurement,
)

from bgpo_trl.analysis import statistics
from bgpo_trl.analysis.tables import Table, markdown
from bgpo_trl.evaluation import Evaluator, start_seeds
from bgpo_trl.experiments.command_line import command_line
from bgpo_trl.figures.style import COLORS, readable, save_figure
from bgpo_trl.files.progress import progress_bar
from bgpo_trl.files.writing import check_folder
from bgpo_trl.machine import set_threads
from bgpo_trl.policy import LoadedRun
from bgpo_trl.runs.provenance import commit_of_code
from bgpo_trl.scenes.nico import NICO, NicoEnv, NicoSimulation
from suites import nico, opengl

Hidden = Literal["places", "objects"]


class HidingSimulation(NicoSimulation):
    """NICO at the table, whose observations hide where the objects are.

    Frames and ground truth show each object at its nominal place and turn; if only places are
    hidden, moved and turned from there as it was since the start of the episode. The arm is shown
    as it is.

    Args:
        tasks: As for `NicoSimulation`, as is ``spread``.
        shown: Physics to show; the true one is only read. Others may share it.
        hidden: ``"places"`` hides where objects started, ``"objects"`` also how they move.
    """

    def __init__(
        self, tasks: Sequence[str], *, shown: nico.Physics, hidden: Hidden, spread: float = 1.0
    ) -> None:
        super().__init__(tasks, spread=spread)
        self._hides_movement = hidden == "objects"
        self._shown = shown
        joints = [shown.model.joint(name).qposadr[0] for name in nico.OBJECTS]
        self._poses = np.add.outer(joints, np.arange(7))
        upright = [[1.0, 0.0, 0.0, 0.0]] * len(nico.OBJECTS)
        self._nominal = np.hstack([nico.nominal_places(), upright])
        self._start = self._nominal

    def reset(self, task: str) -> None:
        """Begin an episode of a task."""
        super().reset(task)
        self._start = self.environment.physics.data.qpos[self._poses].copy()

    def _show(self) -> nico.Physics:
        """Return the physics to show, in its state of this moment."""
        true, shown = self.environment.physics.data.qpos, self._shown
        poses = self._nominal
        if not self._hides_movement:
            poses = _moved(self._nominal, self._start, true[self._poses])
        shown.data.qpos[:] = true
        shown.data.qpos[self._poses] = poses
        # All that is drawn follows from positions, hence without contacts and forces.
        mujoco.mj_kinematics(shown.model.ptr, shown.data.ptr)
        mujoco.mj_camlight(shown.model.ptr, shown.data.ptr)
        return shown

    def frame(self) -> NDArray[np.uint8]:
        """Return NICO's view of the shown scene, ``[32, 64, 3]``."""
        return self.draw(self._show())

    def state(self) -> NDArray[Any]:
        """Return the ground truth of the shown scene, ``[16]``."""
        return self.environment.task.get_observation(self._show())["privileged_state"]


class HidingEnv(NicoEnv):
    """`NicoEnv` of `HidingSimulation`.

    Args:
        tasks: As for `NicoEnv`, as are all other arguments.
        hidden: As for `HidingSimulation`.
    """

    def __init__(
        self, tasks: Sequence[str] = nico.PAPER_TASKS, *, hidden: Hidden, **arguments: Any
    ) -> None:
        self._hidden: Hidden = hidden
        self._shown = nico.Physics.from_xml_string(nico.scene_xml())
        super().__init__(tasks, **arguments)

    def _simulation(self) -> HidingSimulation:
        return HidingSimulation(
            self.tasks, shown=self._shown, hidden=self._hidden, spread=self._spread
        )


def _moved(poses: NDArray, start: NDArray, now: NDArray) -> NDArray:
    """Move and turn poses ``[N, 7]``, position and quaternion, as others from ``start`` to now."""
    out = poses.copy()
    out[:, :3] += now[:, :3] - start[:, :3]
    back, turn = np.empty((2, 4))
    for i in range(len(poses)):
        mujoco.mju_negQuat(back, start[i, 3:])
        mujoco.mju_mulQuat(turn, now[i, 3:], back)
        mujoco.mju_mulQuat(out[i, 3:], turn, poses[i, 3:])
    return out


VIEWS: dict[str, Hidden | None] = {
    "seen": None,
    "places hidden": "places",
    "objects hidden": "objects",
}
"""The part of the scene hidden from the policy, by the name of the condition."""
RANDOM = "random actions"
"""Name of the condition without a policy."""

# Number of the evaluation; it seeds start states that no other test uses.
_NUMBER = 2**31 + 2


class Row(NamedTuple):
    """Success of a seed on a task in one condition, a row of ``looking.csv``."""

    condition: str
    seed: int
    task: str
    episodes: int
    success: float


def measure_looking(
    run: LoadedRun, episodes: int, watch: Callable[[], object] = lambda: None
) -> list[Row]:
    """Test the policies of all seeds of a run in each condition, without noise.

    Starts and demonstrations, held-out ones, are the same in all conditions. Random actions, played
    from the same starts, show what needs neither eyes nor learning.

    Args:
        run: The run.
        episodes: Test episodes of each task and seed.
        watch: Called at each step of the policies, at most ``max_steps + 1`` times a condition.
    """
    config, found = run.config, {}
    held_out = run.bank.held_out(config.held_out)
    for name, hidden in VIEWS.items():
        scene = NICO
        if hidden is not None:
            scene = replace(NICO, make_env=partial(HidingEnv, hidden=hidden))
        evaluator = Evaluator(config, held_out, run.encoders, episodes=episodes, scene=scene)
        snapshots = evaluator.snapshots(run.algorithm, _NUMBER)
        success = evaluator.run(snapshots, run.algorithm.device, watch).success
        found[name] = success.double().mean(-1).numpy()
        evaluator.simulation.close()
    found[RANDOM] = np.array([_by_chance(run, seed, episodes) for seed in config.seeds])
    return [
        Row(name, seed, task, episodes, round(float(success[i, j]), 4))
        for name, success in found.items()
        for i, seed in enumerate(config.seeds)
        for j, task in enumerate(config.tasks)
    ]


def _by_chance(run: LoadedRun, seed: int, episodes: int) -> NDArray[np.float64]:
    """Return the success of random actions from a seed's starts, ``[T]``."""
    tasks, max_steps = run.config.tasks, run.config.algorithm.max_steps
    starts = start_seeds(seed, _NUMBER, (len(tasks), episodes))
    played = play(tasks, starts, seed, random_actions, max_steps, run.config.spread)
    return np.reshape([episode.success for episode in played], starts.shape).mean(-1)


def success_by_condition(rows: Iterable[Row]) -> tuple[tuple[str, ...], dict[str, NDArray]]:
    """Return the tasks, and each condition's success ``[S, T]``, in the order of the rows."""
    found: dict[str, dict[int, list[float]]] = {}
    tasks = dict[str, None]()
    for row in rows:
        tasks[row.task] = None
        found.setdefault(row.condition, {}).setdefault(row.seed, []).append(row.success)
    return tuple(tasks), {name: np.array([*seeds.values()]) for name, seeds in found.items()}


def looking_table(rows: Iterable[Row]) -> Table:
    """Return the table of success (%) by task and condition: mean over seeds, 95 % t interval.

    The last row holds the means over tasks. A single seed has no interval.
    """
    tasks, found = success_by_condition(rows)
    table: Table = [["success, %", *found]]
    for column, task in enumerate(tasks):
        table.append([task, *(statistics.mean(s[:, column]).percent() for s in found.values())])
    table.append(["all", *(statistics.mean(s.mean(1)).percent() for s in found.values())])
    return table


_WIDTH = 0.8  # of the bars of a task, whose centers are 1 apart


def plot_bars(success: Mapping[str, ArrayLike], tasks: Sequence[str]) -> Figure:
    """Plot the success on each task as a group of bars, one for each condition.

    Bars are means over seeds, with 95 % t intervals if there are at least two seeds, and a dot for
    each seed.

    Args:
        success: Success in [0, 1] of each seed and task, ``[S, T]``, by condition.
        tasks: Names of the tasks.
    """
    found = {name: np.asarray(scores, float) for name, scores in success.items()}
    width = max(3.6, 1.0 + 0.28 * len(tasks) * len(found))  # inches
    figure = Figure(figsize=(width, 3.2), layout="constrained")
    axes = figure.add_subplot()
    slim = _WIDTH / len(found)
    for number, (name, scores) in enumerate(found.items()):
        mean = scores.mean(0)
        places = np.arange(len(tasks)) + (number - (len(found) - 1) / 2) * slim
        color = COLORS[number % len(COLORS)]
        axes.bar(places, mean, slim * 0.9, color=color, alpha=0.75, label=name)
        if len(scores) > 1:
            low, high = np.clip(np.transpose([statistics.mean(s)[1:] for s in scores.T]), 0.0, 1.0)
            axes.errorbar(
                places, mean, [mean - low, high - mean], fmt="none", ecolor="0.2", elinewidth=0.9
            )
            around = np.linspace(-0.2, 0.2, len(scores)) * slim
            axes.scatter(
                np.add.outer(around, places),
                scores,
                s=4,
                color="0.2",
                linewidths=0,
                zorder=3,
                clip_on=False,
            )
    names = [readable(task).replace(" to ", "\nto ") for task in tasks]
    axes.set_xticks(range(len(tasks)), names)
    style_success(figure, axes)
    axes.grid(visible=False, axis="x")
    return figure


def looking(arguments: TrainedArguments) -> str:
    """Test the policies of a run with the places of the objects hidden from them.

    They are tested as they are; with places hidden, where each object is shown at its nominal place
    plus how far it has moved since the start; and with objects hidden, where each is always shown
    at its nominal place. Beside them it plays random actions from the same starts. Prints a table
    and writes looking.csv, looking.png and looking.json (commit and command) into the run
    directory.

    Raises:
        ValueError: If the run cannot be loaded.
        OSError: If the results cannot be written.
    """
    commit, out = commit_of_code(), arguments.out or arguments.run
    set_threads(1)
    opengl.check()  # before the progress bar
    runs, rows = load_blocks(arguments.run, of_nico=True), list[Row]()
    check_folder(out)
    for run in runs:
        steps = len(VIEWS) * (run.config.algorithm.max_steps + 1)
        with progress_bar("looking", total=steps, unit="step") as bar:
            rows += measure_looking(run, arguments.episodes, bar.update)
    write_measurement(out, "looking", pd.DataFrame(rows), commit)
    tasks, success = success_by_condition(rows)
    save_figure(plot_bars(success, tasks), out / "looking.png")
    return markdown(looking_table(rows))


if __name__ == "__main__":
    command_line(looking)
