"""Ctrl-C and SIGTERM that wait until a step is over."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

_USUAL = {  # handlers, of SIGTERM also that of command lines, which resume after it
    signal.SIGINT: (signal.default_int_handler,),
    signal.SIGTERM: (signal.SIG_DFL, signal.default_int_handler),
}


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
        number: signal.getsignal(number)
        for number, handlers in _USUAL.items()
        if in_main and signal.getsignal(number) in handlers
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
