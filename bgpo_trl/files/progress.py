"""The progress bar of every long stage."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import Any

from tqdm import tqdm


def progress_bar(
    stage: str, iterable: Iterable[Any] | None = None, *, shown: bool = True, **arguments: Any
) -> tqdm:
    """Returns a `tqdm` bar with the stage's name and its ETA.

    At a terminal it is redrawn ten times a second. Elsewhere, as in a log file, each time adds a
    line, so it is redrawn every 30 seconds. Give ``refresh=False`` to its ``set_postfix``, which
    would redraw it each time.

    Args:
        stage: What is going on.
        iterable: What to iterate over, if not counted by ``update``.
        shown: Whether there is to be a bar at all.
        **arguments: Further ones of `tqdm`, such as ``total``, ``initial`` and ``unit``.

    Example:
        >>> sum(progress_bar("count", range(4), shown=False))
        6
    """
    seconds = 0.1 if sys.stderr.isatty() else 30.0
    return tqdm(
        iterable,
        desc=stage,
        disable=not shown,
        mininterval=seconds,
        maxinterval=max(10.0, seconds),  # after which tqdm redraws it in any case
        **arguments,
    )
