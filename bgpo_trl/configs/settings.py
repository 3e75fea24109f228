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
            hint, value = hints[field.name], getattr(self, field.name)
            try:
                object.__setattr__(self, field.name, _plain(hint, value))
            except TypeError:
                need = _NAMES.get(hint) or (hint.__name__ if isinstance(hint, type) else str(hint))
                options = get_args(hint) if get_origin(hint) is Literal else ()
                need = " or ".join(map(str, options)) or need
                raise ValueError(f"{field.name} must be {need}, got {value}") from None
            except NotImplementedError:
                raise ValueError(
                    f"{field.name} is annotated as {hint}, which config.json cannot hold: annotate "
                    "it as a number, a string, a bool, a dataclass, a tuple of one of them "
                    "(tuple[int, ...]), or one or None"
                ) from None


def _plain(hint: Any, value: Any) -> Any:
    """Return a value as its annotated type.

    Raises:
        TypeError: If it is of another.
        NotImplementedError: If files do not hold such a type.
    """
    if hasattr(value, "tolist"):  # of NumPy or PyTorch
        value = value.tolist()
    kinds = get_args(hint)
    if get_origin(hint) is Literal:
        found = value in kinds
    elif len(kinds) == 2 and kinds[1] is type(None):
        return None if value is None else _plain(kinds[0], value)
    elif get_origin(hint) is tuple and kinds[1:] == (...,):
        if isinstance(value, list | tuple | range):
            return tuple(_plain(kinds[0], item) for item in value)
        found = False
    elif hint is int or hint is float:
        number: Any = Integral if hint is int else Real
        if isinstance(value, number) and not isinstance(value, bool):
            return hint(value)
        found = False
    elif isinstance(hint, type) and (hint in (bool, str) or is_dataclass(hint)):
        found = isinstance(value, hint)
    else:
        raise NotImplementedError
    if not found:
        raise TypeError
    return value
