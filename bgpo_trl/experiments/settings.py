"""Settings of a run: those of a preset, of a file, and of the flags on top."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import tyro

from bgpo_trl.algorithms import ALGORITHMS, entry
from bgpo_trl.configs import PRESETS, RunConfig
from bgpo_trl.configs.algorithms import AlgorithmConfig
from bgpo_trl.experiments.arguments import SETTINGS, Arguments
from bgpo_trl.runs.config_file import Digests, read_config
from bgpo_trl.runs.directory import differing_settings
from bgpo_trl.scenes import SCENES, Scene, find_scene


def run_config(
    arguments: Arguments, *, from_start: bool = False, changes: Mapping[str, Any] | None = None
) -> RunConfig:
    """Return the settings that a command line asks for.

    Raises:
        ValueError: If the settings are invalid, or a file, task or algorithm does not exist.
    """
    config, name = begun_with(arguments)[0], arguments.algorithm
    scene = find_scene(arguments.scene or config.scene)
    if name is not None and name != config.name:
        config = replace(config, name=name, algorithm=entry(name).config)
        if scene.name != PRESETS["quick"].scene:  # which the usual hyperparameters are for
            config = replace(config, algorithm=_fitting(config.algorithm, scene))
    if scene.name != config.scene:
        config = _in_scene(config, scene)
    if arguments.tasks is not None:
        config = _with_tasks(config, chosen_tasks(arguments.tasks, scene))
    if arguments.episodes is not None:
        config = _with_episodes(config, arguments.episodes)
    given = {name: value for name, value in (changes or {}).items() if value is not None}
    config = replace(config, **given)
    if arguments.settings:
        program = f"bgpo {'concurrent' if from_start else 'continual'}"
        config = tyro.cli(SETTINGS, prog=program, default=config, args=arguments.settings)
    if from_start:
        if arguments.add_task is not None:
            raise ValueError("--add-task: a task that comes later is for `bgpo continual`")
        if any(config.task_starts) and (arguments.gives("task_starts") or "task_starts" in given):
            raise ValueError("--task-starts: all tasks are presented from the start here")
        config = replace(config, task_starts=(0,) * len(config.tasks))
    if config.eval_every > config.episodes:
        raise ValueError(
            f"eval_every must be at most the {config.episodes} episodes of the run, got "
            f"{config.eval_every}: its tests are its results"
        )
    if max(config.task_starts) >= config.episodes:
        raise ValueError(
            f"task_starts must be below the {config.episodes} episodes of the run, got "
            f"{max(config.task_starts)}: a task that starts later is never trained nor tested"
        )
    return config


def begun_with(arguments: Arguments) -> tuple[RunConfig, Digests]:
    """Return the settings that flags change: of a run to be resumed, of a file, or a preset's.

    Beside them are the digests of a run's files, if the settings are of one.

    Raises:
        ValueError: If the file is missing or invalid, or ``--algorithm`` would drop what it says.
    """
    path, preset = arguments.config, PRESETS[arguments.preset or "quick"]
    if path is None:
        path = named_directory(arguments)
        stored = arguments.resume and arguments.preset is None
        if not stored or path is None or not (path / "config.json").exists():
            return replace(preset, algorithm=ALGORITHMS[preset.name].config), Digests(None, None)
    path = path / "config.json" if path.is_dir() else path
    if not path.exists():
        raise ValueError(f"--config: there is no file {path}: name one, or a run directory")

    def usual(settings: dict[str, Any]) -> RunConfig:
        own, asked = settings.get("name"), arguments.algorithm
        of_file = "algorithm" in settings and "algorithm_class" not in settings  # not of a run
        if of_file and None not in (own, asked) and own != asked:
            raise ValueError(
                f"--algorithm {asked}: {path} has hyperparameters of {own}: leave one out"
            )
        name = asked if own is None else own
        name = name if isinstance(name, str) and name in ALGORITHMS else preset.name
        config = replace(preset, name=name, algorithm=ALGORITHMS[name].config)
        scene = settings.get("scene", arguments.scene)
        if isinstance(scene, str) and scene in SCENES and scene != config.scene:
            config = _in_scene(config, find_scene(scene))
        # Task starts that the file lacks are those of its tasks and of its length.
        episodes, tasks = settings.get("episodes"), settings.get("tasks")
        if isinstance(episodes, int) and episodes >= 1:
            config = _with_episodes(config, episodes)
        if isinstance(tasks, list) and tasks and all(isinstance(task, str) for task in tasks):
            config = _with_tasks(config, tuple(tasks))
        return config

    return read_config(path, usual)


def named_directory(arguments: Arguments) -> Path | None:
    """Return the run directory that a command line names.

    It is ``--out`` or, with ``--resume`` and neither ``--preset`` nor ``--config``, the current
    folder if it holds a run.
    """
    given = (arguments.out, arguments.preset, arguments.config)
    if arguments.resume and given == (None, None, None):
        here = Path.cwd()
        if all((here / name).exists() for name in ("config.json", "train.csv")):
            return here
    return arguments.out


def _in_scene(config: RunConfig, scene: Scene) -> RunConfig:
    """Return a run of the usual tasks of another scene, with episodes of their length."""
    algorithm = _fitting(config.algorithm, scene)
    return _with_tasks(replace(config, scene=scene.name, algorithm=algorithm), scene.default_tasks)


def _fitting(algorithm: AlgorithmConfig, scene: Scene) -> AlgorithmConfig:
    """Return hyperparameters with episodes as long as a scene's."""
    rl = replace(algorithm.rl, warmup_steps=max(algorithm.rl.warmup_steps, scene.max_steps))
    return replace(algorithm, max_steps=scene.max_steps, rl=rl)


def _with_tasks(config: RunConfig, tasks: tuple[str, ...]) -> RunConfig:
    same = len(tasks) == len(config.task_starts)
    starts = config.task_starts if same else even_starts(len(tasks), config.episodes)
    return replace(config, tasks=tasks, task_starts=starts)


def _with_episodes(config: RunConfig, episodes: int) -> RunConfig:
    share, last = episodes / config.episodes, episodes - 1
    starts = tuple(min(round(start * share), last) for start in config.task_starts)
    every = max(1, min(config.eval_every, episodes))
    return replace(config, episodes=episodes, task_starts=starts, eval_every=every)


def chosen_tasks(tasks: tuple[str, ...] | None, scene: Scene) -> tuple[str, ...]:
    """Return the tasks of a scene that ``--tasks`` names, by default its usual ones.

    Raises:
        ValueError: If there are none, or as from `Scene.check_tasks`.
    """
    if tasks is None:
        return scene.default_tasks
    if not tasks:
        raise ValueError(f"--tasks: name some of {', '.join(scene.tasks)}")
    tasks = scene.all_tasks if tasks == ("all",) else tasks
    scene.check_tasks(tasks)
    return tasks


def even_starts(n_tasks: int, episodes: int) -> tuple[int, ...]:
    """Return the episodes from which tasks are presented at even intervals."""
    return tuple(position * episodes // n_tasks for position in range(n_tasks))


def changed_hyperparameters(config: RunConfig) -> dict[str, Any]:
    """Return the hyperparameters of a run that are not the usual ones of its algorithm, by name."""
    if config.name not in ALGORITHMS:
        return {}
    usual = ALGORITHMS[config.name].config
    scene = find_scene(config.scene)
    if scene.name != RunConfig().scene:
        usual = _in_scene(replace(config, algorithm=usual), scene).algorithm
    different = differing_settings(asdict(usual), asdict(config.algorithm))
    return {name: value for name, _, value in different}
