"""Settings of a run, read from its ``config.json``."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

from bgpo_trl.algorithms import ABLATIONS, ALGORITHMS
from bgpo_trl.algorithms.rl import RL
from bgpo_trl.configs import AlgorithmConfig, RLConfig, RunConfig
from bgpo_trl.runs.directory import plain_settings


def read_config(path: str | Path) -> tuple[RunConfig, str | None]:
    """Read the settings that `Trainer` wrote: the inverse of ``dataclasses.asdict``.

    Settings missing from a run of an earlier version get their defaults.

    Args:
        path: The ``config.json`` of a run.

    Returns:
        The settings, and the identity of the run's encoders; ``None`` if it used none.

    Raises:
        ValueError: If the file is missing, or was not written by this version.
    """
    path = Path(path)
    try:
        settings = json.loads(path.read_text())
        if not isinstance(settings, dict) or not isinstance(settings.get("algorithm"), dict):
            raise ValueError("it holds no settings of a run")
        encoders = settings.pop("encoders", None)
        if not isinstance(encoders, str | None):
            raise ValueError(f"encoders is {encoders!r}")
        values = settings.pop("algorithm")
        kind = _algorithm_config(settings.get("name"), settings.pop("algorithm_class", None))
        algorithm = _read(kind, values, "algorithm.")
        return _read(RunConfig, {**settings, "algorithm": algorithm}, ""), encoders
    except (FileNotFoundError, NotADirectoryError):
        raise ValueError(f"{path.parent} holds no run: there is no {path.name}") from None
    except (ValueError, OSError, RecursionError) as error:
        raise ValueError(
            f"{path} cannot be read ({error}): use the version of the code that made the run"
        ) from error


def settings_of(config: RunConfig, encoders: str | None) -> dict[str, Any]:
    """Return the content of ``config.json``: all settings and the class of the hyperparameters.

    Args:
        config: The run.
        encoders: Identity of its encoders; None if it uses none.
    """
    kind = type(config.algorithm)
    name = f"{kind.__module__}.{kind.__qualname__}"
    return plain_settings({**asdict(config), "algorithm_class": name, "encoders": encoders})


def _algorithm_config(name: object, stored: object) -> type[AlgorithmConfig]:
    """Return the class of an algorithm's hyperparameters.

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
    known = ALGORITHMS | ABLATIONS
    if isinstance(name, str) and name in known:
        return type(known[name].config)
    raise ValueError(f"the hyperparameters of {name!r} are of no known algorithm")


def _read(hint: Any, value: Any, where: str) -> Any:
    """Convert a JSON value to its annotated type; ``where`` names it in errors."""
    if hint is RLConfig and isinstance(value, dict):
        name = value.get("name")
        if name not in RL:
            raise ValueError(f"{where}name is {name!r}, not a known RL algorithm")
        hint = type(RL[name].config)
    if is_dataclass(hint) and isinstance(value, dict):
        hints = get_type_hints(hint)
        unknown = sorted(value.keys() - hints.keys())
        if unknown:
            raise ValueError(f"unknown setting {where}{unknown[0]}")
        read = {key: _read(hints[key], item, f"{where}{key}.") for key, item in value.items()}
        return hint(**read)  # pyright: ignore[reportCallIssue]
    if get_origin(hint) is tuple and isinstance(value, list):
        return tuple(_read(get_args(hint)[0], item, where) for item in value)
    if get_origin(hint) is Literal and value in get_args(hint):
        return value
    if hint is float and type(value) is int:
        return float(value)
    if isinstance(hint, type) and (type(value) is hint or is_dataclass(value)):
        return value
    raise ValueError(f"{where.rstrip('.')} is {value!r}")
