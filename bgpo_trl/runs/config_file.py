"""Settings of a run, read from its ``config.json`` or from a file of one's own."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any, NamedTuple, get_args, get_type_hints

import yaml

from bgpo_trl.algorithms import ALGORITHMS
from bgpo_trl.configs import AlgorithmConfig, RunConfig
from bgpo_trl.runs.results import RepeatedKeyError, parse_json, read_json
from bgpo_trl.scenes import SCENES, find_scene

_YAML = (".yaml", ".yml")


class Digests(NamedTuple):
    """Digests of the files that a run was trained with.

    Attributes:
        encoders: That of its encoders; None if it used none.
        bank: That of the demonstrations of its tasks; None in files that are of no run.
    """

    encoders: str | None
    bank: str | None


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader, with two rules of YAML 1.2: 1e-4 is a number, and keys are unique."""

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        """Return the node of a mapping; raise `RepeatedKeyError` if it gives a key twice."""
        # Not in construct_mapping, where a mapping also has the keys that it merges (<<).
        node = super().compose_mapping_node(anchor)
        found = set[tuple[str, str]]()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):
                if (key.tag, key.value) in found:
                    where = f"{self.name}, line {key.start_mark.line + 1},"
                    raise RepeatedKeyError(where, key.value)
                found.add((key.tag, key.value))
        return node


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?[0-9]+(\.[0-9]*)?[eE][-+]?[0-9]+$"),
    [*"-+0123456789"],
)


def read_settings(path: Path) -> dict[str, Any]:
    """Return the entries of a file of settings.

    Args:
        path: YAML file if its name ends in ``.yaml`` or ``.yml``, else JSON.

    Raises:
        ValueError: If the file is missing or damaged, gives a key twice, or is no mapping of names
            to values.
    """
    if path.suffix not in _YAML:
        return read_json(path)
    try:
        with path.open() as file:
            found = yaml.load(file, Loader=_Loader)
    except RepeatedKeyError:
        raise
    except (yaml.YAMLError, OSError, ValueError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark is not None else ""
        reason = getattr(error, "problem", None) or next(iter(str(error).splitlines()), "")
        raise ValueError(f"{path}{where} is not YAML ({reason}): correct it") from None
    if not isinstance(found, dict) or not all(isinstance(name, str) for name in found):
        raise ValueError(
            f"{path} must hold settings, one `name: value` a line, as config.json does"
        )
    return found


def read_config(path: str | Path, defaults: RunConfig | None = None) -> tuple[RunConfig, Digests]:
    """Read the settings that `Trainer` wrote: the inverse of ``dataclasses.asdict``.

    Settings that the file lacks get their defaults.

    Args:
        path: The ``config.json`` of a run, or another file that `read_settings` reads.
        defaults: Settings that the file may lack, also all of the algorithm; by default, those of
            the classes.

    Returns:
        The settings, and the digests of the encoders and demonstrations.

    Raises:
        ValueError: If the file is missing, was not written by this version, gives a key twice, or
            names a task or hyperparameters that this process does not know.
    """
    path = Path(path)
    of_run = path.name == "config.json"
    try:
        settings = parse_json(path) if of_run else read_settings(path)
        if defaults is not None and isinstance(settings, dict):
            settings = _merged(_as_json(asdict(defaults)), settings)
        if not isinstance(settings, dict) or not isinstance(settings.get("algorithm"), dict):
            raise ValueError("it holds no settings of a run")
        digests = Digests(*(settings.pop(name, None) for name in Digests._fields))
        for name, found in digests._asdict().items():
            if not isinstance(found, str | None):
                raise ValueError(f"{name} is {found!r}")
        values, modules = settings.pop("algorithm"), settings.pop("task_modules", {})
        settings.pop("scene_version", None)  # `check_settings` compares it
        name, scene = settings.get("name"), settings.get("scene", "nico")
        kind = _algorithm_config(name, settings.pop("algorithm_class", None))
        if kind is None:
            raise LookupError(f"is a run of {name!r}, whose hyperparameters no imported module has")
        if scene not in SCENES:
            raise LookupError(f"is a run in the scene {scene!r}, which no imported module adds")
        unknown = _unknown_task(scene, settings.get("tasks"))
        if unknown is not None:
            # The module is not imported, since a file should not decide what is imported.
            module = modules.get(unknown) if isinstance(modules, dict) else None
            known = isinstance(module, str) and module != "__main__"
            where = f"the module {module!r}" if known else "a script or notebook"
            raise LookupError(f"has the task {unknown!r}, added by {where}")
        algorithm = _built(kind, values, "algorithm")
        return _built(RunConfig, {**settings, "algorithm": algorithm}), digests
    except (FileNotFoundError, NotADirectoryError):
        raise ValueError(f"{path.parent} holds no run: there is no {path.name}") from None
    except LookupError as error:
        raise ValueError(
            f"{path} {error}: name the module that adds it with --import, or import it first in "
            "Python"
        ) from None
    except RepeatedKeyError:
        raise
    except (ValueError, OSError, RecursionError) as error:
        remedy = "use the version of the code that made the run" if of_run else "correct it"
        raise ValueError(f"{path} cannot be read ({error}): {remedy}") from error


def settings_of(config: RunConfig, digests: Digests) -> dict[str, Any]:
    """Return the content of ``config.json``.

    In addition to all settings, it names the class of the hyperparameters, the version of the scene
    and the modules of tasks that are not the paper's.

    Args:
        config: The run.
        digests: Digests of its encoders and demonstrations.
    """
    kind, scene = type(config.algorithm), find_scene(config.scene)
    settings = {
        **asdict(config),
        "algorithm_class": f"{kind.__module__}.{kind.__qualname__}",
        "scene_version": scene.full_version,
        "task_modules": dict(scene.modules(config.tasks)),
        **digests._asdict(),
    }
    return _as_json(settings)


def _as_json(settings: dict[str, Any]) -> dict[str, Any]:
    """Return settings as JSON stores them, tuples as lists."""
    return json.loads(json.dumps(settings))


def _merged(defaults: dict[str, Any], settings: dict[str, Any]) -> dict[str, Any]:
    """Return settings, with those of ``defaults`` that they lack and that have the same name."""
    if defaults.get("name") != settings.get("name", defaults.get("name")):
        return settings  # of another algorithm
    merged = {**defaults, **settings}
    for name, old in defaults.items():
        if isinstance(old, dict) and isinstance(merged[name], dict):
            merged[name] = _merged(old, merged[name])
    return merged


def _unknown_task(scene: object, tasks: object) -> str | None:
    """Return the first task that is not in a scene; None if there is none, or no list."""
    if not (isinstance(scene, str) and scene in SCENES and isinstance(tasks, list)):
        return None
    known = find_scene(scene).tasks
    return next((name for name in tasks if isinstance(name, str) and name not in known), None)


def _algorithm_config(name: object, stored: object) -> type[AlgorithmConfig] | None:
    """Return the class of an algorithm's hyperparameters; None if it is unknown.

    Args:
        name: Of the algorithm.
        stored: Its name in the file; None in files without it. Only classes of modules that this
            process has imported are found, since a file should not decide what is imported.
    """
    if isinstance(stored, str):
        module, _, attribute = stored.rpartition(".")
        kind = getattr(sys.modules.get(module), attribute, None)
        if isinstance(kind, type) and issubclass(kind, AlgorithmConfig):
            return kind
    if not isinstance(name, str) or name not in ALGORITHMS:
        return None
    return type(ALGORITHMS[name].config)


def _built(kind: type, values: dict[str, Any], where: str = "") -> Any:
    """Return settings of a class from a file; ``where`` names them in errors."""
    hints, prefix = get_type_hints(kind), f"{where}." if where else ""
    unknown = sorted(values.keys() - hints.keys(), key=str)
    if unknown:
        raise ValueError(f"unknown setting {prefix}{unknown[0]}")
    settings = dict(values)
    for name, value in values.items():
        inner = next((t for t in (hints[name], *get_args(hints[name])) if is_dataclass(t)), None)
        if isinstance(inner, type) and isinstance(value, dict):
            settings[name] = _built(inner, value, f"{prefix}{name}")
    try:
        return kind(**settings)
    except ValueError as error:
        raise ValueError(f"{where}: {error}" if where else str(error)) from None
