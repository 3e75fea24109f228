"""A small run of three tasks, presented one after the other; and runs written by hand."""

import itertools
import json
from pathlib import Path

import numpy as np
import pandas as pd

from bgpo_trl.runs.results import Run
from suites import nico

NAN = np.nan
STARTS = (0, 10, 20)
# Tests after 5, 10, ..., 30 episodes of tasks a, b and c, which start at 0, 10 and 20.
SUCCESS = [
    [0.2, NAN, NAN],
    [0.8, NAN, NAN],
    [0.6, 0.4, NAN],
    [0.7, 0.6, NAN],
    [0.5, 0.7, 0.0],
    [0.5, 0.9, 0.4],
]
TASKS = nico.PAPER_TASKS
HEAD = "algorithm,seed,episode,env_steps,task,success,return,steps\n"


def make_run(success=SUCCESS, starts=STARTS, tasks="abc", *, schedule="practised", **summary):
    """Tests every 5 episodes, of success ``[S, E, T]``, or ``[E, T]`` of two equal seeds."""
    success = np.asarray(success)
    success = success if success.ndim == 3 else np.stack([success] * 2)
    seeds, episodes = range(len(success)), 5 * np.arange(1, success.shape[1] + 1)
    config = {"name": "bgpo", "task_starts": list(starts), "tasks": list(tasks), "eval_every": 5}
    config |= {"seeds": [*seeds], "episodes": int(episodes[-1]), "schedule": schedule}
    every = pd.MultiIndex.from_product(
        [seeds, episodes, list(tasks)], names=["seed", "episode", "task"]
    )
    tests = pd.DataFrame({"success": success.ravel()}, every).dropna().reset_index()
    return Run((Path("x"),), config, summary, tests.assign(steps=NAN))


def write_run(
    folder, name, levels, *, episodes=40, starts=(0, 0, 0), tasks=TASKS, directory=None, **changes
):
    """A run whose seeds succeed in so many of ten tests in the last fifth, in half before.

    ``levels`` are numbers by seed, or one of all three seeds.
    """
    levels = [levels] * 3 if isinstance(levels, int) else levels
    path = folder / (directory or f"{'continual' if any(starts) else 'concurrent'}-{name}")
    path.mkdir(parents=True)
    config = {"name": name, "seeds": list(range(len(levels))), "task_starts": list(starts)}
    config |= {"tasks": list(tasks), "episodes": episodes, "eval_every": 2, "eval_episodes": 10}
    config |= {"held_out": "validation", "encoders": "e" * 64, "algorithm": {"max_steps": 50}}
    config["schedule"] = "practised"
    (path / "config.json").write_text(json.dumps(config | changes))
    told = {"commit": "abc", "command": "python x", "needs_label": name.startswith("maml")}
    (path / "summary.json").write_text(json.dumps(told))
    lines = []
    for seed, level in enumerate(levels):
        for episode in range(2, episodes + 1, 2):
            for task, start in zip(tasks, starts, strict=True):
                if episode > start:
                    won = level if episode > 0.8 * episodes else level // 2
                    lines += [
                        f"{name},{seed},{episode},9,{task},{int(test < won)},0,{5 + test}"
                        for test in range(10)
                    ]
    (path / "eval.csv").write_text(HEAD + "\n".join(lines) + "\n")
    return path


def write_training(directory, seeds, tasks=TASKS):
    """Writes a train.csv from outcomes by task, one list a seed; tasks take turns."""
    lines = [f"{HEAD.strip()},intrinsic_return,num_nodes,group,num_groups,loss_actor,loss_value"]
    for seed, of_tasks in enumerate(seeds):
        turns = [
            (task, success)
            for row in itertools.zip_longest(*of_tasks)
            for task, success in zip(tasks, row, strict=True)
            if success is not None
        ]
        for episode, (task, success) in enumerate(turns, 1):
            group = tasks.index(task)
            lines.append(
                f"bgpo,{seed},{episode},9,{task},{success},0,5,0.1,{episode + 1},{group},"
                f"{min(episode, len(tasks))},0.5,0.25"
            )
    (directory / "train.csv").write_text("\n".join(lines) + "\n")
