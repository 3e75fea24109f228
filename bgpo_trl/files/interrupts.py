"""Ctrl-C and the termination signal, deferred to the next point at which a run can be stopped."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

_USUAL = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}


@contextmanager
def interrupts_wait() -> Iterator[Callable[[], bool]]:
    """Defer the first Ctrl-C or SIGTERM to the end of the block; a second one interrupts at once.

    SIGTERM is what ``kill`` and cluster schedulers send before they end a process. Both raise
    ``KeyboardInterrupt``. Yields a function that returns whether a signal came. Signal handling is
    left unchanged outside the main thread, and of a signal that is ignored (Ctrl-C of background
    jobs) or has a custom handler.
    """
    asked = False

    def ask(signum: int, frame: Any) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True

    in_main = threading.current_thread() is threading.main_thread()
    usual = {
        number: handler
        for number, handler in _USUAL.items()
        if in_main and signal.getsignal(number) is handler
    }
    for number in usual:
        signal.signal(number, ask)
    try:
        yield lambda: asked
    finally:
        for number, handler in usual.items():
            signal.signal(number, handler)
    if asked:
        raise KeyboardInterrupt
