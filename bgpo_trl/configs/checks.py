"""Checks of hyperparameters."""

from __future__ import annotations

from math import inf
from numbers import Integral


def check(config: object, *needs: tuple[str, bool, str]) -> None:
    """Raise ``ValueError`` for the first (field, condition, description) that does not hold."""
    for name, holds, need in needs:
        if not holds:
            raise ValueError(f"{name} must be {need}, got {getattr(config, name)}")


def at_least(config: object, least: int, *names: str) -> None:
    """Raise ``ValueError`` for a field that is smaller than ``least``, or not finite."""
    for name in names:
        check(config, (name, least <= getattr(config, name) < inf, f"at least {least}"))


def whole(config: object, least: int, *names: str) -> None:
    """Raise ``ValueError`` for a field that is not a whole number of at least ``least``."""
    for name in names:
        check(config, (name, isinstance(getattr(config, name), Integral), "a whole number"))
    at_least(config, least, *names)


def positive(config: object, *names: str) -> None:
    """Raise ``ValueError`` for a field that is not positive, or not finite."""
    for name in names:
        check(config, (name, 0 < getattr(config, name) < inf, "a number above 0"))
