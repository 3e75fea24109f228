"""Settings that are plain: numbers, text, tuples of these, and other settings."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from numbers import Integral, Real
from typing import Any, Literal, get_args, get_origin, get_type_hints

_NAMES = {int: "a whole number", float: "a number", str: "text", bool: "true or false"}


class Settings:
    """Base of dataclasses of settings, which converts values to the annotated types.

    NumPy's numbers become Python's; lists, ranges and arrays become tuples. A run thus stores what
    it was given. A field is annotated as a number, ``str``, ``bool``, ``Literal``, a dataclass, a
    tuple of one of these (``tuple[int, ...]``), or one of these or None.

    Raises:
        ValueError: If a value is of another type, or a field is annotated otherwise.
    """

    def __post_init__(self) -> None:
        hints = get_type_hints(type(self))
        for field in fields(self):  # pyright: ignore[reportArgumentType]
            name, hint, value = field.name, hints[field.name], getattr(self, field.name)
            need = _description(hint)
            if not need:
                raise ValueError(
                    f"{name} is annotated as {hint}, which config.json cannot hold: annotate it as "
                    "a number, a string, a bool, a dataclass, a tuple of one of them "
                    "(tuple[int, ...]), or one or None"
                )
            try:
                object.__setattr__(self, name, _plain(hint, value))
            except TypeError:
                raise ValueError(f"{name} must be {need}, got {value}") from None


def _description(hint: Any) -> str:
    """Return what values of a type are, in words; "" for a type that files do not hold."""
    kinds = get_args(hint)
    if get_origin(hint) is Literal:
        return " or ".join(map(str, kinds))
    if len(kinds) == 2 and type(None) in kinds:
        inner = _description(kinds[0])
        return inner and f"{inner}, or None"
    if get_origin(hint) is tuple and kinds[1:] == (...,):
        inner = _description(kinds[0])
        return inner and f"a tuple, each {inner}"
    if is_dataclass(hint):
        return f"of the class {hint.__name__}"  # pyright: ignore[reportAttributeAccessIssue]
    return _NAMES.get(hint, "")


def _plain(hint: Any, value: Any) -> Any:
    """Return a value as its annotated type; raise ``TypeError`` if it is of another."""
    if hasattr(value, "tolist"):  # of NumPy or PyTorch
        value = value.tolist()
    kinds = get_args(hint)
    if get_origin(hint) is Literal and value in kinds:
        return value
    if type(None) in kinds and get_origin(hint) is not Literal:
        return None if value is None else _plain(kinds[0], value)
    if get_origin(hint) is tuple and isinstance(value, list | tuple | range):
        return tuple(_plain(kinds[0], item) for item in value)
    if hint is bool or isinstance(value, bool):
        if hint is bool and isinstance(value, bool):
            return value
    elif hint is int and isinstance(value, Integral):
        return int(value)
    elif hint is float and isinstance(value, Real):
        return float(value)
    elif (hint is str and isinstance(value, str)) or (is_dataclass(hint) and is_dataclass(value)):
        return value
    raise TypeError
