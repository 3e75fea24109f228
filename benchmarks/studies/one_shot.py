"""Success and task inference against the share of the demonstration that is shown.

python benchmarks/studies/one_shot.py runs/continual-bgpo-quick
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from shared import TrainedArguments, write_measurement

from bgpo_trl.analysis.tables import Table, markdown
from bgpo_trl.analysis.task_inference import task_inference_accuracy
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.data.recording import new_demonstrations
from bgpo_trl.encoders.representation import embed_demonstrations
from bgpo_trl.evaluation import Evaluator, Snapshot
from bgpo_trl.experiments.command_line import command_line
from bgpo_trl.figures.style import COLORS, add_legend, readable, save_figure, style_axes
from bgpo_trl.files.writing import check_folder
from bgpo_trl.machine import set_threads
from bgpo_trl.policy import TrainedPolicy, load_run
from bgpo_trl.runs.provenance import commit_of_code
from bgpo_trl.seeding import stream_seed

# Number of the evaluation; it seeds start states that neither training nor final tests used.
_NUMBER = 2**31 + 1
_MEASURES = ["success", "task_inference", "activity"]


@dataclass(frozen=True, kw_only=True)
class OneShotArguments(TrainedArguments):
    """Tests with demonstrations that are cut short."""

    shares: tuple[float, ...] = (0.25, 0.5, 0.75, 1.0)
    """Shares of each demonstration to show, from its start."""
    episodes: int = 20
    """Demonstrations and test episodes per task and seed."""
    seed: int = 1
    """Seed of the demonstrations; the pretrained encoders were trained on seed 0."""


def show(
    policy: TrainedPolicy, embedding: torch.Tensor, task: torch.Tensor, evaluator: Evaluator
) -> pd.DataFrame:
    """Test the policies of all seeds, each with the same demonstrations.

    Args:
        policy: Policy of one of the seeds.
        embedding: Embeddings phi of the demonstrations, ``[T, M, 32]``.
        task: Task labels, ``[T, M]``.
        evaluator: Evaluator for ``M`` episodes of ``T`` tasks.

    Returns:
        A row of each seed and task, with the success, the share of demonstrations whose task was
        inferred, and the mean activity; the last two are NaN without GWR-B.
    """
    algorithm, seeds = policy.algorithm, policy.config.seeds
    n_tasks, n_seeds = len(task), len(seeds)
    snapshots = []
    for index, seed in enumerate(seeds):
        generator = torch.Generator().manual_seed(stream_seed(seed, "one-shot"))
        snapshots.append(
            Snapshot(
                number=_NUMBER,
                episode=0,
                env_steps=0,
                presented=torch.ones(n_tasks, dtype=torch.bool),
                policy=algorithm.snapshot(index, embedding, task, generator),
            )
        )
    success = evaluator.run(snapshots, algorithm.device).success.double().mean(-1)
    inferred, activity = torch.full((2, n_seeds, n_tasks), torch.nan, dtype=torch.double)
    if algorithm.gwr is not None:
        activity = algorithm.gwr.lookup(embedding.expand(n_seeds, *embedding.shape)).activity
        activity, seen = activity.mean(-1).double(), policy.bank.seen(policy.config.demonstrations)
        for number, (phi, label) in enumerate(zip(embedding, task, strict=True)):
            tested = DemonstrationBank(
                phi, label, torch.zeros_like(label, dtype=torch.bool), policy.tasks
            )
            inferred[:, number] = task_inference_accuracy(algorithm.gwr, seen, tested)
    measured = {"success": success, "task_inference": inferred, "activity": activity}
    columns = {name: values.flatten().numpy() for name, values in measured.items()}
    index = pd.MultiIndex.from_product([seeds, policy.tasks], names=["seed", "task"])
    return pd.DataFrame(columns, index).reset_index()


def measure(
    policy: TrainedPolicy, shares: Sequence[float], episodes: int, seed: int
) -> pd.DataFrame:
    """Return the rows of ``one_shot.csv``; for the arguments see `OneShotArguments`.

    Raises:
        ValueError: If a share is not in (0, 1].
    """
    if not shares or not all(0 < share <= 1 for share in shares):
        raise ValueError(f"--shares are in (0, 1], got {', '.join(map(str, shares)) or 'none'}")
    tasks, config = policy.tasks, policy.config
    evaluator = Evaluator(config, policy.bank.held_out(), policy.encoders, episodes=episodes)
    shown = new_demonstrations(
        scene=config.scene,
        tasks=tasks,
        per_task=episodes,
        spread=config.spread,
        seed=seed,
        progress=False,
    )
    length, tables = shown.get("length").clone(), []
    for share in shares:
        shown["length"] = (share * length).round().long().clamp(min=1)
        embedding = embed_demonstrations(policy.encoders, shown).view(len(tasks), episodes, -1)
        table = show(policy, embedding, shown["task"].view(len(tasks), episodes), evaluator)
        table.insert(0, "share", share)
        table.insert(3, "episodes", episodes)
        tables.append(table)
    return pd.concat(tables, ignore_index=True)


def means(table: pd.DataFrame) -> dict[str, dict[float, np.ndarray]]:
    """Return each seed's mean success, task inference and activity, ``[S, 3]``, by task and share.

    The key ``"all"`` holds the means over tasks.
    """
    return {
        task: {
            share: of_task[of_task["share"] == share]
            .groupby("seed", sort=False)[_MEASURES]
            .mean()
            .to_numpy()
            for share in table["share"].unique()
        }
        for task, of_task in [("all", table), *table.groupby("task", sort=False)]
    }


def plot(table: Mapping[str, Mapping[float, np.ndarray]]) -> Figure:
    """Plot success and task inference against the share of the demonstration shown.

    Lines are means over seeds, by task and over all tasks, the latter shaded by one standard
    deviation. Algorithms without GWR-B have no task inference.
    """
    names = ["Success rate", "Task inferred"]
    if all(np.isnan(seeds[:, 1]).all() for shares in table.values() for seeds in shares.values()):
        names.pop()
    figure = Figure(figsize=(7.0, 3.2), layout="constrained")
    panels = figure.subplots(1, len(names), sharex=True, sharey=True, squeeze=False)[0]
    for column, (axes, name) in enumerate(zip(panels, names, strict=True)):
        for number, (task, shares) in enumerate(table.items(), -1):  # "all" is the first
            color = "#222222" if task == "all" else COLORS[number % len(COLORS)]
            shown = sorted(shares)
            seeds = np.stack([shares[share][:, column] for share in shown])
            mean, spread = seeds.mean(1), seeds.std(1)
            axes.plot(shown, mean, "o-", color=color, markersize=4, label=readable(task))
            if task == "all":
                low, high = np.clip(mean - spread, 0, 1), np.clip(mean + spread, 0, 1)
                axes.fill_between(shown, low, high, color=color, alpha=0.15, linewidth=0)
        axes.set(xticks=sorted(next(iter(table.values()))), ylim=(0, 1.02))
        axes.set_title(name, fontsize=9)
        axes.xaxis.set_major_formatter(PercentFormatter(1, decimals=0))
        style_axes(axes)
    figure.supxlabel("Share of the demonstration seen", fontsize=9)
    handles, labels = panels[0].get_legend_handles_labels()
    add_legend(figure, handles, labels, 7.0)
    return figure


def one_shot(arguments: OneShotArguments) -> str:
    """Test the policies of a run with new demonstrations that are cut short.

    Prints a table and writes one_shot.csv, one_shot.png and one_shot.json (commit and command) into
    the run directory.

    Raises:
        ValueError: If the run cannot be loaded, or a share is not in (0, 1].
        OSError: If the results cannot be written.
    """
    commit, out = commit_of_code(), arguments.out or arguments.run
    set_threads(1)
    policy = load_run(arguments.run)
    check_folder(out)
    tested = measure(policy, arguments.shares, arguments.episodes, arguments.seed)
    write_measurement(out, "one_shot", tested.round(dict.fromkeys(_MEASURES, 4)), commit)
    found = means(tested)
    save_figure(plot(found), out / "one_shot.png")
    table: Table = [["task", "seen", "success", "inferred", "activity"]]
    for task, shares in found.items():
        for share, seeds in shares.items():
            success, inferred, activity = seeds.mean(0)
            from_gwr = ["", ""] if np.isnan(inferred) else [f"{inferred:.1%}", f"{activity:.2f}"]
            table.append([task, f"{share:.0%}", f"{success:.1%}", *from_gwr])
    return markdown(table)


if __name__ == "__main__":
    command_line(one_shot)
