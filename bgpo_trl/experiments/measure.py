"""Measurements and drawings at the end of a run: final tests, task inference, figures, videos."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure

from bgpo_trl.algorithms import Algorithm
from bgpo_trl.analysis.scores import final_means
from bgpo_trl.analysis.task_inference import (
    group_purity,
    majority_task,
    match_counts,
    task_inference_accuracy,
)
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.evaluation import Evaluator, evaluate_random_policy
from bgpo_trl.figures.frames import file_names, plot_frame_strips, save_gif
from bgpo_trl.figures.groups import plot_groups
from bgpo_trl.figures.gwr import plot_gwr_pca
from bgpo_trl.figures.style import save_figure
from bgpo_trl.figures.success import plot_step_curves, plot_success_curves
from bgpo_trl.files.progress import progress_bar
from bgpo_trl.runs.provenance import each_once, write_table
from bgpo_trl.runs.results import COLUMNS, Run, read_run
from bgpo_trl.scenes import find_scene
from bgpo_trl.training import Trainer

# Number of the evaluation after training; it seeds start states that training never tested.
_LAST = 2**31
_SELDOM = 0.75


def measure(
    trainer: Trainer, bank: DemonstrationBank, out: Path, episodes: int = 20
) -> dict[str, Any]:
    """Test the trained policies with seen and with held-out demonstrations.

    Dashboards get the success with held-out ones.
    """
    algorithm, config = trainer.algorithm, trainer.config
    gwr, tests = algorithm.gwr, _final_tests(trainer, bank, episodes=episodes)
    write_table(out / "final.csv", tests)
    trainer.dashboard.log_final(tests[tests["demonstrations"] == "held-out"], config.episodes)
    random_success = evaluate_random_policy(
        tasks=config.tasks,
        episodes=100,
        spread=config.spread,
        max_steps=config.algorithm.max_steps,
        scene=config.scene,
    )
    summary = {
        "commit": each_once(start["commit"] for start in trainer.starts),
        "command": each_once(start["command"] for start in trainer.starts),
        "episodes": config.episodes,
        "learned_episodes": trainer.world.source.episode.tolist(),
        "random_success": dict(zip(config.tasks, random_success.tolist(), strict=True)),
        "demonstrated_steps": demonstrated_steps(bank.seen(config.demonstrations)),
        "needs_label": algorithm.needs_label,
        "needs_boundaries": algorithm.needs_boundaries,
        "nodes": None if gwr is None else gwr.num_nodes.tolist(),
        "groups": None,
    }
    if algorithm.groups:
        held_out = bank.held_out(config.held_out)
        summary["groups"] = [len(groups.numbers) for groups in algorithm.groups]
        summary["group_purity"] = [group_purity(groups, held_out) for groups in algorithm.groups]
    return summary


def demonstrated_steps(bank: DemonstrationBank) -> dict[str, float]:
    """Return the mean number of steps of the demonstrations of each task.

    Tasks of which no steps are stored are left out.
    """
    if bank.steps is None:
        return {}
    frames = {name: bank.steps.length[bank.task == n] for n, name in enumerate(bank.tasks)}
    kept = {name: of_task[of_task > 0] for name, of_task in frames.items()}
    # A demonstration has a frame before its first step.
    return {name: float(k.double().mean()) - 1 for name, k in kept.items() if len(k)}


def _final_tests(trainer: Trainer, bank: DemonstrationBank, *, episodes: int) -> pd.DataFrame:
    """Return the rows of ``final.csv``, after as many test episodes of each task and kind."""
    algorithm, config = trainer.algorithm, trainer.config
    seen = bank.seen(config.demonstrations)
    gwr, rows = algorithm.gwr, []
    n_steps = config.algorithm.max_steps + 1
    bar = progress_bar("final tests", shown=trainer.progress, total=2 * n_steps, unit="step")
    for half, (kind, tested) in enumerate(
        (("seen", seen), ("held-out", bank.held_out(config.held_out))), 1
    ):
        evaluator = _evaluator(trainer, tested, episodes)
        snapshots = evaluator.snapshots(algorithm, _LAST)
        result = evaluator.run(snapshots, algorithm.device, watch=bar.update)
        evaluator.env.close()  # hundreds of simulations, of several MB each
        success = result.success
        bar.set_postfix_str(f"success {success.float().mean():.2f}, {kind}", refresh=False)
        bar.update(half * n_steps - bar.n)  # episodes may all end earlier
        for task, name in enumerate(config.tasks):
            of_task = tested.of_task(task)
            inferred = torch.full((len(config.seeds),), torch.nan)
            if gwr is not None:
                inferred = task_inference_accuracy(gwr, seen, of_task)
            for index, seed in enumerate(config.seeds):
                won = success[index, task]
                steps = result.steps[index, task][won].double().mean()  # NaN without a success
                means = ((won.float().mean(), 4), (steps, 2), (inferred[index], 4))
                cells = (round(float(mean), digits) for mean, digits in means)
                rows.append((seed, kind, name, episodes, *cells))
    bar.close()
    return pd.DataFrame(rows, columns=pd.Index([*COLUMNS["final.csv"]]))


def _evaluator(trainer: Trainer, bank: DemonstrationBank, episodes: int) -> Evaluator:
    config = trainer.config
    return Evaluator(config, bank, trainer.encoders, episodes=episodes, starts=config.task_starts)


def draw(
    trainer: Trainer, bank: DemonstrationBank, out: Path, summary: Mapping[str, Any]
) -> list[str]:
    """Draw the figures of the run, and describe it.

    Returns:
        Lines about the success in each task, and about GWR-B, its task inference and its groups.
    """
    config = trainer.config
    run = replace(read_run(out), summary=dict(summary))
    lines = success_lines(run)
    save_figure(plot_success_curves({config.name: run}), out / "figures" / "success.png")
    if (run.tests["success"] == 1).any():
        save_figure(plot_step_curves({config.name: run}), out / "figures" / "steps.png")
    # A policy of the ground truth needs no frames, so there are none.
    episodes = record_episodes(trainer, bank) if config.algorithm.state == "latent" else {}
    if episodes:
        save_figure(plot_frame_strips(episodes), out / "figures" / "episodes.png")
    for name, frames in zip(file_names(config.tasks), episodes.values(), strict=False):
        save_gif(frames, out / "figures" / f"{name}.gif", fps=find_scene(config.scene).rate or 5.0)
    if summary["nodes"] is not None:
        seen = bank.seen(config.demonstrations)
        save_figure(plot_first_gwr(trainer.algorithm, seen), out / "figures" / "gwr.png")
        inferred = np.asarray(final_means(run, "held-out", "task_inference"))
        lines.append(f"GWR-B nodes: {summary['nodes']}")
        lines.append(f"task inference on held-out demonstrations: {inferred.mean():.1%}")
    if summary["groups"] is not None:
        save_figure(plot_groups(run), out / "figures" / "groups.png")
        purity = np.mean(summary["group_purity"])
        lines.append(
            f"groups of behaviors: {summary['groups']}, {purity:.1%} of held-out demonstrations in "
            "a group of their task"
        )
    return lines


def plot_first_gwr(algorithm: Algorithm, seen: DemonstrationBank) -> Figure:
    """Plot the first seed's GWR-B (Fig. 7); ``seen`` defines its nodes' majority tasks."""
    assert algorithm.gwr is not None
    weights = algorithm.gwr.graph(0).weights
    tasks = majority_task(match_counts(algorithm.gwr, seen)[0])[: len(weights)]
    groups = algorithm.groups[0].lookup(weights).group if algorithm.groups else None
    return plot_gwr_pca(weights, tasks, seen.tasks, groups)


def success_lines(run: Run) -> list[str]:
    """Return a line for each task about the final tests, and what to do if one seldom succeeds.

    Of the tests, those with held-out demonstrations.
    """
    success, steps = (final_means(run, "held-out", column) for column in ("success", "steps"))
    if success is None:
        return []
    assert run.final is not None
    tests = run.final[run.final["demonstrations"] == "held-out"]
    n_tests = tests.groupby("task")["episodes"].sum()
    shown, lines = run.summary["demonstrated_steps"], list[str]()
    for index, task in enumerate(run.tasks):
        line = f"{task}: {success[:, index].mean():.0%} of {n_tests[task]} held-out tests succeed"
        if steps is not None and not np.isnan(steps[:, index]).all():
            line += f", in {np.nanmean(steps[:, index]):.1f} steps"
            line += f" (demonstrated in {shown[task]:.1f})" if task in shown else ""
        lines.append(line)
    if success.mean(0).min() < _SELDOM:
        lines.append("a task seldom succeeds: docs/extending.md says where to look, one by one")
    return lines


def record_episodes(trainer: Trainer, bank: DemonstrationBank) -> dict[str, np.ndarray]:
    """Return the frames of a test episode of each task with the first seed's trained policy.

    Returns:
        Frames uint8 ``[N, H, W, 3]``, by task and outcome.

    Raises:
        ValueError: If the run observes ground truth instead of frames.
    """
    config, frames = trainer.config, []
    evaluator = _evaluator(trainer, bank.held_out(config.held_out), 1)
    result = evaluator.run(
        evaluator.snapshots(trainer.algorithm, _LAST),
        trainer.algorithm.device,
        watch=lambda: frames.append(evaluator.simulation.frames()[0, :, 0]),
    )
    return {
        f"{name} ({'success' if result.success[0, task, 0] else 'no success'})": np.stack(
            [frame[task] for frame in frames[: int(result.steps[0, task, 0]) + 1]]
        )
        for task, name in enumerate(config.tasks)
    }
