"""What a check finds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Finding:
    """What came of one check.

    Attributes:
        level: ``"ok"``; ``"note"``, usable but; ``"wrong"``, unusable.
        what: What was looked at.
        told: What was found, and where it is amiss what to do; one line.
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
