"""The paper's three experiments: tasks in sequence, all tasks from the start, the ablation.

Each trains to the end and returns its results as text. What trains is imported when it is called,
so that ``--help`` need not wait for TorchRL.
"""

from __future__ import annotations

from dataclasses import replace

from bgpo_trl.experiments.arguments import AblationArguments, Arguments


def continual(arguments: Arguments) -> str:
    """Train an algorithm on tasks that are presented one after the other (Fig. 8).

    Writes a run directory: config.json, train.csv, eval.csv, final.csv, gwr.csv, cost.csv,
    summary.json, checkpoint/ and figures/, among them success.png (success on each task against
    training episodes), gwr.png (nodes of GWR-B in behavior space, Fig. 7) and groups.png.
    """
    from bgpo_trl.experiments.run import run_experiment
    from bgpo_trl.experiments.settings import run_config

    return run_experiment(arguments, "continual", run_config(arguments))


def concurrent(arguments: Arguments) -> str:
    """Train an algorithm on tasks that are all presented from the start (Fig. 6).

    Writes the same files as the continual experiment, and differs from it only in the schedule.
    """
    from bgpo_trl.experiments.run import run_experiment
    from bgpo_trl.experiments.settings import run_config

    return run_experiment(arguments, "concurrent", run_config(arguments, from_start=True))


def ablation(arguments: AblationArguments) -> str:
    """Train BGPO without GWR-B, the intrinsic reward, or both (Fig. 9), or with our additions.

    The paper's variants differ by transforms alone. All tasks are presented from the start, with
    --continual one after the other.

    Raises:
        ValueError: If ``--algorithm`` is given, or the variant is none of `ABLATIONS`.
    """
    from bgpo_trl.algorithms import ABLATIONS
    from bgpo_trl.experiments.run import run_experiment
    from bgpo_trl.experiments.settings import run_config

    if arguments.algorithm is not None:
        raise ValueError("--algorithm: the variants are BGPO's, name one with --variant")
    if arguments.variant not in ABLATIONS:
        known = ", ".join(ABLATIONS)
        raise ValueError(f"--variant: there is no {arguments.variant!r}; name one of {known}")
    from_start = not arguments.continual
    arguments = replace(arguments, algorithm=arguments.variant)
    config = run_config(arguments, from_start=from_start)
    name = "ablation" if from_start else "ablation-continual"
    return run_experiment(arguments, name, config)
