"""Progress bar of the long-running stages."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import Any

from tqdm import tqdm


def progress_bar(
    stage: str, iterable: Iterable[Any] | None = None, *, shown: bool = True, **arguments: Any
) -> tqdm:
    """Return a ``tqdm`` bar with the stage's name and the remaining time.

    It is redrawn ten times a second on a terminal and every 30 seconds elsewhere, since each redraw
    adds a line to a log file. Pass ``refresh=False`` to ``set_postfix``, which otherwise redraws.
    Without an iterable, progress is counted by ``update``. Further arguments go to ``tqdm``.
    """
    seconds = 0.1 if sys.stderr.isatty() else 30.0
    return tqdm(
        iterable,
        desc=stage,
        disable=not shown,
        mininterval=seconds,
        maxinterval=max(10.0, seconds),  # tqdm redraws after this time in any case
        **arguments,
    )
