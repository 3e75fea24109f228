"""Results of the doctor's checks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Finding:
    """Result of one check.

    Attributes:
        level: ``"ok"``; ``"note"`` for usable with a limitation; ``"wrong"`` for unusable.
        what: Subject of the check.
        told: Result in one line, with a remedy if something is wrong.
    """

    level: Literal["ok", "note", "wrong"]
    what: str
    told: str

    def __str__(self) -> str:
        return f"{self.level:<7}{self.what:<14}{self.told}"


Check = Callable[[], Iterator[Finding]]


def first_line(error: Exception) -> str:
    """Return the first line of an error's message, or its class if there is none."""
    return next(iter(str(error).splitlines()), type(error).__name__)
