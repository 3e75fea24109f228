"""Settings of a run, read from its ``config.json`` or from a file of one's own."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any, NamedTuple, get_args, get_type_hints

import yaml

from bgpo_trl.algorithms import ALGORITHMS
from bgpo_trl.configs import AlgorithmConfig, RepresentationConfig, RunConfig
from bgpo_trl.scenes import SCENES, find_scene


class Digests(NamedTuple):
    """Digests of the files that a run was trained with.

    Attributes:
        encoders: That of its encoders; None if it used none.
        bank: That of the demonstrations of its tasks; None in files that are of no run.
        logged: That of the logged episodes that it began with; None, and not stored, without any.
    """

    encoders: str | None
    bank: str | None
    logged: str | None = None


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader, with rules of YAML 1.2: for numbers (1e-4, 010), and unique keys."""

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        # Not in construct_mapping, where a mapping also has the keys that it merges (<<).
        node = super().compose_mapping_node(anchor)
        keys = [key.value for key, _ in node.value]
        for place, (key, _) in enumerate(node.value):
            if key.value in keys[:place]:
                given = f"{key.value!r} is given twice"
                raise yaml.MarkedYAMLError(problem=given, problem_mark=key.start_mark)
        return node

    def construct_yaml_int(self, node: Any) -> int:
        return int(self.construct_scalar(node))


_INT, _FLOAT = "tag:yaml.org,2002:int", "tag:yaml.org,2002:float"
_Loader.yaml_implicit_resolvers = {
    first: [rule for rule in rules if rule[0] not in (_INT, _FLOAT)]
    for first, rules in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
for _tag, _number in (
    (_INT, r"[-+]?[0-9]+$"),
    (_FLOAT, r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?$|[-+]?\.(inf|nan)$"),
):
    _Loader.add_implicit_resolver(_tag, re.compile(_number), [*"-+.0123456789"])
_Loader.add_constructor(_INT, _Loader.construct_yaml_int)


def _read_settings(path: Path) -> dict[str, Any]:
    """Return the entries of a file of settings, YAML or JSON, which is YAML too."""
    try:
        found = yaml.load(path.read_text(), Loader=_Loader)
    except FileNotFoundError:
        raise ValueError(f"{path.parent} holds no run: there is no {path.name}") from None
    except (yaml.YAMLError, OSError, ValueError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark is not None else ""
        reason = getattr(error, "problem", None) or next(iter(str(error).splitlines()), "")
        raise ValueError(f"{path}{where} cannot be read ({reason}): correct it") from None
    if not isinstance(found, dict) or not all(isinstance(name, str) for name in found):
        raise ValueError(
            f"{path} must hold settings: put one `name: value` a line, or correct config.json"
        )
    return found


def read_config(
    path: str | Path, usual: Callable[[dict[str, Any]], RunConfig] | None = None
) -> tuple[RunConfig, Digests]:
    """Read the settings that `Trainer` wrote: the inverse of ``dataclasses.asdict``.

    Args:
        path: The ``config.json`` of a run, or another file of settings, YAML or JSON.
        usual: Returns settings that the file may lack, given those that stand there; by default,
            they are those of the classes.

    Returns:
        The settings, and the digests of the encoders and demonstrations.

    Raises:
        ValueError: If the file is missing, was not written by this version, gives a key twice, or
            names a task or hyperparameters that this process does not know.
    """
    path = Path(path)
    settings = _read_settings(path)
    if usual is not None:
        given = usual(settings)
        settings = _merged(_as_json(asdict(given)), settings)
    try:
        return _of_settings(settings)
    except LookupError as error:
        raise ValueError(
            f"{path} {error.args[0]}: name the module that adds it with --import, or import it "
            "first in Python"
        ) from None
    except (ValueError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{path} cannot be read ({error}): correct it or, for a run, use the version of the "
            "code that made it"
        ) from error


def _of_settings(settings: dict[str, Any]) -> tuple[RunConfig, Digests]:
    """Return what `settings_of` was given.

    Raises:
        LookupError: If the scene or a task is unknown to this process.
        ValueError: If a setting is unknown or out of range; also ``TypeError``, ``AttributeError``.
    """
    settings, digests = dict(settings), Digests(None, None)
    if "algorithm_class" in settings:  # Of a run; in another file, they would be names of files.
        digests = Digests(*(settings.pop(name, None) for name in Digests._fields))
    modules = settings.pop("task_modules", {})
    settings.pop("scene_version", None)  # `load_last` compares it
    kind = _algorithm_config(settings.get("name"), settings.pop("algorithm_class", None))
    scene = settings.get("scene", "nico")
    if scene not in SCENES:
        raise LookupError(f"is a run in the scene {scene!r}, which no imported module adds")
    for task in settings.get("tasks", ()):
        if task not in find_scene(scene).tasks:
            # The module is not imported, since a file should not decide what is imported.
            module = modules.get(task, "a script or notebook")
            raise LookupError(f"has the task {task!r}, added by {module!r}")
    algorithm = _built(kind, settings.get("algorithm"), "algorithm")
    return _built(RunConfig, {**settings, "algorithm": algorithm}), digests


def read_encoder_settings(path: Path, defaults: RepresentationConfig) -> RepresentationConfig:
    """Read settings of encoders, such as ``vae: {steps: 2000}``; the file may lack ``defaults``.

    Raises:
        ValueError: If the file is missing or damaged, or holds a setting unknown or out of range.
    """
    if not path.is_file():
        raise ValueError(f"there is no file of settings {path}")
    settings = _merged(_as_json(asdict(defaults)), _read_settings(path))
    try:
        return _built(RepresentationConfig, settings)
    except ValueError as error:
        raise ValueError(f"{path} cannot be read ({error}): correct it") from None


def settings_of(config: RunConfig, digests: Digests) -> dict[str, Any]:
    """Return the content of ``config.json``.

    In addition to all settings, it names the class of the hyperparameters, the version of the scene
    and the modules of tasks that are not the paper's.

    Raises:
        ValueError: If the settings could not be read again, so that the run could not be loaded.
    """
    kind, scene = type(config.algorithm), find_scene(config.scene)
    settings = {
        **asdict(config),
        "algorithm_class": f"{kind.__module__}.{kind.__qualname__}",
        "scene_version": scene.full_version,
        "task_modules": dict(scene.modules(config.tasks)),
        **{name: found for name, found in digests._asdict().items() if found or name != "logged"},
    }
    settings = _as_json(settings)
    try:
        same, reason = _of_settings(settings)[0] == config, "others would come back"
    except (LookupError, ValueError, TypeError, AttributeError) as error:
        same, reason = False, str(error.args[0])
    if not same:
        raise ValueError(
            f"config.json could not hold these settings ({reason}): add fields to the class of the "
            "algorithm alone, and define it at the top of a module"
        )
    return settings


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


def _algorithm_config(name: Any, stored: Any) -> type[AlgorithmConfig]:
    """Return the class of an algorithm's hyperparameters: ``stored``, if it is imported.

    A file should not decide what is imported. Without that class, it is the class of the algorithm
    ``name``; raise ``LookupError`` if there is none.
    """
    module, _, attribute = str(stored).rpartition(".")
    kind = getattr(sys.modules.get(module), attribute, None)
    if isinstance(kind, type) and issubclass(kind, AlgorithmConfig):
        return kind
    if name not in ALGORITHMS:
        raise LookupError(f"is a run of {name!r}, whose hyperparameters no imported module has")
    return type(ALGORITHMS[name].config)


def _built(kind: type, values: Any, where: str = "") -> Any:
    """Return settings of a class from a file; ``where`` names them in errors."""
    hints, prefix = get_type_hints(kind), f"{where}." if where else ""
    if not isinstance(values, dict):
        raise ValueError(f"{where} holds no settings")
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
