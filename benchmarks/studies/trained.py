"""Success and steps of trained policies in many tests, and of the two policies they choose from.

    python benchmarks/studies/trained.py runs/continual-bgpo-quick --episodes 200
    python benchmarks/studies/trained.py ... --latest   # what averaging the weights is worth
    python benchmarks/studies/trained.py ... --speeds 1.5 2   # a clone that only moves faster

Starts and held-out demonstrations depend on the seed and the number of tests alone, so that runs of
the same seeds and tasks, such as ``bgpo`` and ``clone``, are tested from the same starts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from shared import TrainedArguments, load_blocks, write_measurement
from torch import Tensor

from bgpo_trl.algorithms.algorithm import Policy
from bgpo_trl.algorithms.bgpo import BGPO
from bgpo_trl.analysis.statistics import mean
from bgpo_trl.analysis.tables import markdown
from bgpo_trl.evaluation import Evaluator, Snapshot
from bgpo_trl.experiments.command_line import command_line
from bgpo_trl.files.progress import progress_bar
from bgpo_trl.files.writing import check_folder
from bgpo_trl.machine import set_threads
from bgpo_trl.policy import LoadedRun
from bgpo_trl.runs.provenance import commit_of_code

# Number of the evaluation; it seeds start states that no other test uses.
_NUMBER = 2**31 + 4

Weights = dict[str, Tensor]


def _choice(weights: Weights) -> Weights:
    return {**weights, "only_clone": torch.zeros_like(weights["only_clone"])}


def _clone(weights: Weights) -> Weights:
    return {**weights, "only_clone": torch.ones_like(weights["only_clone"])}


def _actor(weights: Weights) -> Weights:
    # The actor takes the place of the clone.
    actor = {
        n.replace("actor.", "clone.", 1): w for n, w in weights.items() if n.startswith("actor.")
    }
    return {**_clone(weights), **actor}


POLICIES: dict[str, Callable[[Weights], Weights]] = {
    "as in tests": lambda weights: weights,
    "critics choose": _choice,
    "clone alone": _clone,
    "actor alone": _actor,
}
"""Changes of the weights of a `ProposalPolicy`, by the name of the policy that results."""


@dataclass(frozen=True, kw_only=True)
class WeightsArguments(TrainedArguments):
    """Tests of the policies of a run."""

    latest: bool = False
    """Test the latest weights, instead of their averages, with which all tests act."""
    speeds: tuple[float, ...] = ()
    """Test the clone also with its actions times these: what speed is worth without reward."""


class Row(NamedTuple):
    """Tests of a seed's policy on a task, a row of ``trained.csv``."""

    policy: str
    seed: int
    task: str
    episodes: int
    success: float
    steps: float | None
    """Mean length of the successful tests; None without one."""


@dataclass(frozen=True)
class FasterPolicy(Policy):
    """A policy whose actions are multiplied by ``speed``."""

    speed: float = 1.0

    def act(self, state: Tensor) -> Tensor:
        """Return actions ``[*B, A]`` in [-1, 1] for states ``[*B, features]``."""
        return (self.speed * super().act(state)).clamp(-1.0, 1.0)


def measure_trained(
    run: LoadedRun,
    episodes: int,
    watch: Callable[[], object] = lambda: None,
    *,
    speeds: Sequence[float] = (),
) -> list[Row]:
    """Test the policies of all seeds of a run, without noise.

    Policies that do not choose between proposals are tested as they are.

    Args:
        run: The run.
        episodes: Test episodes of each task and seed.
        watch: Called at each step of the policies.
        speeds: Factors of the clone's actions with which it is tested, too.
    """
    config, rows = run.config, list[Row]()
    held_out = run.bank.held_out(config.held_out)
    evaluator = Evaluator(config, held_out, run.encoders, episodes=episodes)
    snapshots = evaluator.snapshots(run.algorithm, _NUMBER)
    chooses = all("only_clone" in snapshot.policy.parameters for snapshot in snapshots)
    policies = POLICIES if chooses else dict([*POLICIES.items()][:1])
    imitates = "clone alone" if chooses else "as in tests"
    variants = [(name, name, 1.0) for name in policies]
    variants += [(f"{imitates} x {speed:g}", imitates, speed) for speed in speeds]
    for name, policy, speed in variants:
        tested = [_changed(snapshot, policies[policy], speed) for snapshot in snapshots]
        result = evaluator.run(tested, run.algorithm.device, watch)
        for i, seed in enumerate(config.seeds):
            for j, task in enumerate(config.tasks):
                success, steps = result.success[i, j], result.steps[i, j]
                mean = round(steps[success].double().mean().item(), 2) if success.any() else None
                share = round(success.double().mean().item(), 4)
                rows.append(Row(name, seed, task, episodes, share, mean))
    evaluator.simulation.close()
    return rows


def _changed(snapshot: Snapshot, change: Callable[[Weights], Weights], speed: float) -> Snapshot:
    given = {**vars(snapshot.policy), "parameters": change(snapshot.policy.parameters)}
    return replace(snapshot, policy=FasterPolicy(**given, speed=speed))


def trained(arguments: WeightsArguments) -> str:
    """Test trained policies often, and the clone, the actor and the critics' choice alone.

    Prints a table of success (%) and steps of a success, means over seeds, and in points what the
    policy of the tests has above the clone, paired by seed; writes trained.csv and trained.json
    (commit and command) into the run directory, of the latest weights trained-latest.csv and
    trained-latest.json.

    Raises:
        ValueError: If the run cannot be loaded.
        OSError: If the results cannot be written.
    """
    commit, out = commit_of_code(), arguments.out or arguments.run
    set_threads(1)
    runs, rows = load_blocks(arguments.run), list[Row]()
    check_folder(out)
    for run in runs:
        if arguments.latest and isinstance(run.algorithm, BGPO):
            run.algorithm.learner.average.clear()
        steps = (len(POLICIES) + len(arguments.speeds)) * (run.config.algorithm.max_steps + 1)
        with progress_bar("trained", total=steps, unit="step") as bar:
            rows += measure_trained(run, arguments.episodes, bar.update, speeds=arguments.speeds)
    table = pd.DataFrame(rows)
    write_measurement(out, "trained-latest" if arguments.latest else "trained", table, commit)
    return summarized(table)


def summarized(table: pd.DataFrame) -> str:
    """Return means over seeds of rows of `measure_trained`, as a table of success and steps."""
    tasks, names = [*table["task"].unique()], [*table["policy"].unique()]
    means = table.groupby(["task", "policy"])[["success", "steps"]].mean()
    rows = [[task, *map(_cell, means.loc[task].loc[names].to_numpy())] for task in tasks]
    if len(names) > 1:
        names.append("above clone")
        success = table.pivot(index=["task", "seed"], columns="policy", values="success")
        above = success["as in tests"] - success["clone alone"]
        for task, cells in zip(tasks, rows, strict=True):
            cells.append(mean(above.loc[task]).points())
    return markdown([["task", *names], *rows])


def _cell(means: NDArray[np.float64]) -> str:
    success, steps = means
    return f"{100 * success:.1f} % in {steps:.1f}" if success else "0.0 %"


if __name__ == "__main__":
    command_line(trained)
