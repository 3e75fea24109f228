"""The aftermath of successes: simulations continued from the states in which episodes succeed.

    python benchmarks/studies/aftermath.py runs/continual-bgpo-quick

A task's condition has to hold for two or three steps, and a learner finds the cheapest thing that
pays. Here a grasped object is lifted, and what was pushed is left alone for two seconds.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import tyro
from numpy.typing import NDArray
from shared import (
    Episode,
    TrainedArguments,
    load_blocks,
    play,
    random_actions,
    write_measurement,
)

from bgpo_trl.analysis.tables import Table, markdown
from bgpo_trl.evaluation import Evaluator, start_seeds
from bgpo_trl.experiments.command_line import command_line
from bgpo_trl.files.writing import check_folder
from bgpo_trl.machine import set_threads
from bgpo_trl.policy import LoadedRun
from bgpo_trl.runs.provenance import commit_of_code
from bgpo_trl.scenes.nico import NicoSimulation
from suites import nico
from suites.nico import kinematics
from suites.nico.base import CONTROL_TIMESTEP, TIME_LIMIT, Environment
from suites.nico.demonstrator import Demonstrator
from suites.nico.physics import HAND, OBJECT_HALF_HEIGHT, TABLE_HEIGHT

LIFT = 0.05  # (m) over the object's place on the table
GAP = 0.015  # (m) between things that still count as together
KEPT = 0.75  # least share of a displacement that remains
STEPS = 10  # steps without action

_DIRECTIONS = (
    (0.0, 1.0, 0.0),
    (0.0, 0.0, 1.0),
    (0.0, 1.0, 1.0),
    (0.0, 1.0, 0.5),
    (0.0, 0.5, 1.0),
    (0.5, 1.0, 1.0),
    (-0.5, 1.0, 1.0),
)
_SPEEDS = ((0.2, 15), (0.5, 6))  # share of the largest action, and steps of the same movement
RAISES = tuple(
    (tuple(speed * part for part in direction), steps)
    for direction, (speed, steps) in itertools.product(_DIRECTIONS, _SPEEDS)
)
"""Ways to raise the arm: actions of shoulder yaw, shoulder pitch and elbow, and their number."""
_HELD_STEPS = 5  # steps at rest after a raise, in which what was thrown falls

_UPRIGHT = 0.95  # least vertical component of the object's axis
_ON_TABLE = 0.01  # (m) largest difference of its height from that of its place on the table
_AT_REST = 0.02  # (m/s) largest speed

# Number of the evaluation; it seeds start states that no other test uses.
_NUMBER = 2**31 + 3


class Outcome(NamedTuple):
    """The outcome of a success.

    Attributes:
        holds: Whether it lasts.
        distance: Lift, gap or displacement (m), by the task's `Criterion`.
    """

    holds: bool
    distance: float


class Continuation:
    """A simulation to be continued from states of others, with the actions of the tasks."""

    def __init__(self) -> None:
        self.physics = nico.Physics.from_xml_string(nico.scene_xml())
        self._task = nico.NicoTask(random=0, observation="state")
        self._n_sub_steps = round(CONTROL_TIMESTEP / self.physics.timestep())

    def begin(self, state: NDArray) -> nico.Physics:
        """Go to a state, as from ``physics.get_state()``, and return the simulation."""
        self.physics.set_state(state)
        return self.physics

    def act(self, action: Iterable[float], steps: int) -> None:
        """Repeat an action ``[4]``."""
        for _ in range(steps):
            self._task.before_step(np.array([*action]), self.physics)
            self.physics.step(self._n_sub_steps)


Judge = Callable[[Continuation, Episode], Outcome]


@dataclass(frozen=True)
class Criterion:
    """Test of whether the successes of a task last."""

    distance: str
    """Name of the distance that is measured."""
    judge: Judge
    """Continues the simulation from the end of an episode."""


def lifts(name: str, then: Continuation, episode: Episode) -> Outcome:
    """Close the hand and raise the arm in each way: the best lift of an object counts.

    The lift is the height over the object's place on the table, a second after the raise; 0 if the
    hand does not touch the object then, which has been thrown or lost.
    """
    best = 0.0
    for arm, steps in RAISES:
        physics = then.begin(episode.end)
        then.act((*arm, 1.0), steps)
        then.act((0.0, 0.0, 0.0, 1.0), _HELD_STEPS)
        if physics.touching(HAND, name):
            best = max(best, _height(physics, name))
    return Outcome(best >= LIFT, best)


def stays_together(first: str, second: str, then: Continuation, episode: Episode) -> Outcome:
    """Do nothing for some steps: do two things, named as in ``physics.gap``, stay together?"""
    physics = then.begin(episode.end)
    then.act(np.zeros(4), STEPS)
    gap = physics.gap(first, second)
    return Outcome(gap <= GAP, gap)


def stays_aside(name: str, side: int, then: Continuation, episode: Episode) -> Outcome:
    """Do nothing for some steps: does an object stand, at rest, where it was pushed to?

    Displacements are measured along the arc from where the object stood at the start, to the left
    for ``side`` 1 and to the right for -1.
    """
    at_start = _arc(then.begin(episode.start), name)
    physics = then.begin(episode.end)
    at_success = side * (_arc(physics, name) - at_start)
    then.act(np.zeros(4), STEPS)
    displacement = side * (_arc(physics, name) - at_start)
    kept = displacement >= KEPT * at_success and displacement > 0
    return Outcome(kept and stands(physics, name), displacement)


def stays_pressed(name: str, then: Continuation, episode: Episode) -> Outcome:
    """Do nothing for some steps: is the hand still on an object, and does this stand?"""
    together = stays_together(HAND, name, then, episode)
    return Outcome(together.holds and stands(then.physics, name), together.distance)


def stands(physics: nico.Physics, name: str) -> bool:
    """Return whether an object stands upright on the table, at rest."""
    upright = physics.named.data.xmat[name, "zz"] > _UPRIGHT
    speed = np.linalg.norm(physics.named.data.qvel[name][:3])
    return bool(upright and speed < _AT_REST and abs(_height(physics, name)) < _ON_TABLE)


def _height(physics: nico.Physics, name: str) -> float:
    """Return the height of an object over its place on the table (m)."""
    height = physics.object_position(name)[2] - TABLE_HEIGHT - OBJECT_HALF_HEIGHT[name]
    return float(height)


def _arc(physics: nico.Physics, name: str) -> float:
    """Return the place of an object along the arc (m), left positive."""
    radius, angle = kinematics.to_polar(physics.object_position(name))
    return radius * angle


CRITERIA: dict[str, Criterion] = {
    "grasp_glass": Criterion("lift", partial(lifts, "glass")),
    "push_green_to_glass": Criterion("gap", partial(stays_together, "green_box", "glass")),
    "push_green_to_white": Criterion("gap", partial(stays_together, "green_box", "white_box")),
    "push_glass_right": Criterion("displacement", partial(stays_aside, "glass", -1)),
    "lift_green": Criterion("lift", partial(lifts, "green_box")),
    "press_white": Criterion("gap", partial(stays_pressed, "white_box")),
    "push_white_left": Criterion("displacement", partial(stays_aside, "white_box", 1)),
    "push_white_right": Criterion("displacement", partial(stays_aside, "white_box", -1)),
}
"""The criterion for a success to last, by task. Modules of own tasks may add entries."""


class Row(NamedTuple):
    """A success and what became of it, a row of ``aftermath.csv``."""

    actor: str
    seed: int
    task: str
    holds: bool
    measure: str
    distance: float


def policy_episodes(run: LoadedRun, episodes: int) -> list[Episode]:
    """Return the test episodes of all seeds' trained policies, as many of each task and seed."""
    held_out = run.bank.held_out(run.config.held_out)
    evaluator = Evaluator(run.config, held_out, run.encoders, episodes=episodes)
    first = list[NDArray]()

    def states() -> NDArray:
        found = [
            simulation.environment.physics.get_state()
            for simulation in evaluator.simulation.simulations
            if isinstance(simulation, NicoSimulation)
        ]
        return np.reshape(found, (*evaluator.shape, -1))

    result = evaluator.run(
        evaluator.snapshots(run.algorithm, _NUMBER),
        run.algorithm.device,
        watch=lambda: None if first else first.append(states()),
    )
    last = states()  # simulations stop where they succeed
    evaluator.simulation.close()
    return [
        Episode(
            run.config.tasks[at[1]],
            run.config.seeds[at[0]],
            bool(result.success[at]),
            first[0][at],
            last[at],
        )
        for at in np.ndindex(*evaluator.shape)
    ]


def scripted_episodes(
    tasks: tuple[str, ...],
    seeds: Iterable[int],
    episodes: int,
    max_steps: int,
    actor: str,
    spread: float = 1.0,
) -> list[Episode]:
    """Return the episodes of an entry of `SCRIPTED`, in the starts of `policy_episodes`."""
    starts = {seed: start_seeds(seed, _NUMBER, (len(tasks), episodes)) for seed in seeds}
    return [
        episode
        for seed, of_seed in starts.items()
        for episode in play(tasks, of_seed, seed, SCRIPTED[actor], max_steps, spread)
    ]


def demonstrate(env: Environment, seed: int) -> Demonstrator:
    """Return the demonstrator of an environment at the start of an episode."""
    demonstrator = Demonstrator(env, seed=seed)
    demonstrator.reset()
    return demonstrator


SCRIPTED = {"demonstrators": demonstrate, "random actions": random_actions}
"""Scripted policies by name."""


def check_criteria(tasks: Iterable[str]) -> None:
    """Raise ``ValueError`` if there is no criterion for a task."""
    missing = [task for task in tasks if task not in CRITERIA]
    if missing:
        raise ValueError(
            f"nothing says what a success of {missing[0]} is worth: add a Criterion to "
            "aftermath.CRITERIA in the module of --import"
        )


def judge(actor: str, episodes: Iterable[Episode]) -> list[Row]:
    """Find out what became of each success among some episodes.

    Raises:
        ValueError: If there is no criterion for a task.
    """
    successes = [episode for episode in episodes if episode.success]
    check_criteria(episode.task for episode in successes)
    then, rows = Continuation(), list[Row]()
    for episode in successes:
        criterion = CRITERIA[episode.task]
        holds, distance = criterion.judge(then, episode)
        row = (episode.task, bool(holds), criterion.distance, round(float(distance), 4))
        rows.append(Row(actor, episode.seed, *row))
    return rows


def aftermath_table(rows: Iterable[Row], played: Mapping[str, Mapping[str, int]]) -> Table:
    """Return the table by actor and task: successes, the share that holds, the median distance.

    Args:
        rows: The successes.
        played: Number of episodes by actor and task.
    """
    rows = list(rows)
    table: Table = [["actor", "task", "successes", "of them hold, %", "median, cm"]]
    for actor, counts in played.items():
        for task, episodes in counts.items():
            found = [row for row in rows if (row.actor, row.task) == (actor, task)]
            cells = ["", ""]
            if found:
                # Adding 0 turns -0.0 into 0.0.
                distance = round(100 * float(np.median([row.distance for row in found])), 1) + 0.0
                share = 100 * np.mean([row.holds for row in found])
                cells = [f"{share:.1f}", f"{distance:.1f} ({found[0].measure})"]
            table.append([actor, task, f"{len(found)} of {episodes}", *cells])
    return table


@dataclass(frozen=True, kw_only=True)
class AftermathArguments(TrainedArguments):
    """Continuations of successes."""

    run: tyro.conf.Positional[Path | None] = None
    """Run directory."""
    demonstrators: bool = False
    """Also test the demonstrators; without a run, those of all tasks."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the starts without a run, which has its own."""
    out: Path | None = None
    """Folder to write to; the run directory, or runs/aftermath, by default."""


def episodes_of(arguments: AftermathArguments) -> dict[str, list[Episode]]:
    """Return the test episodes by actor.

    Raises:
        ValueError: If nobody is to act, or there is no criterion for a task.
    """
    if arguments.run is None and not arguments.demonstrators:
        raise ValueError("nobody acts: name a run directory, or give --demonstrators")
    tasks, seeds, spread = nico.ALL_TASKS, arguments.seeds, 1.0
    max_steps = round(TIME_LIMIT / CONTROL_TIMESTEP)
    episodes: dict[str, list[Episode]] = {}
    if arguments.run is not None:
        runs = load_blocks(arguments.run, of_nico=True)
        config = runs[0].config
        tasks, max_steps, spread = config.tasks, config.algorithm.max_steps, config.spread
        seeds = [seed for run in runs for seed in run.config.seeds]
        check_criteria(tasks)
        played = [policy_episodes(run, arguments.episodes) for run in runs]
        episodes["policy"] = [episode for of_run in played for episode in of_run]
    for actor in ("demonstrators", "random actions")[not arguments.demonstrators :]:
        episodes[actor] = scripted_episodes(
            tasks, seeds, arguments.episodes, max_steps, actor, spread
        )
    return episodes


def aftermath(arguments: AftermathArguments) -> str:
    """Test whether the successes of a run's policies, or of demonstrators, last.

    Continues the simulation from each success: what was grasped is lifted, in the best of fourteen
    ways; what was pushed together, aside or pressed is left alone for two seconds. Beside them it
    plays random actions from the same starts. Prints a table and writes aftermath.csv, one row per
    success, and aftermath.json (commit and command).

    Raises:
        ValueError: As for `episodes_of`, or if the run cannot be loaded.
        OSError: If the results cannot be written.
    """
    commit = commit_of_code()
    set_threads(1)
    out = arguments.out or arguments.run or Path("runs/aftermath")
    check_folder(out)
    episodes = episodes_of(arguments)
    rows = [row for actor, of_actor in episodes.items() for row in judge(actor, of_actor)]
    table = pd.DataFrame(rows, columns=pd.Index(Row._fields))
    write_measurement(out, "aftermath", table, commit)
    counts = {actor: Counter(e.task for e in of_actor) for actor, of_actor in episodes.items()}
    return markdown(aftermath_table(rows, counts))


if __name__ == "__main__":
    import aftermath as module  # the one whose CRITERIA a module of --import extends

    command_line(module.aftermath)
