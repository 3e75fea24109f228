"""Work shared between the caller's thread and helpers."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, wait
from typing import TypeVar

T = TypeVar("T")


class RowPool:
    """Threads that share the rows of a batch; the caller's is one of ``n``.

    ``name`` is the prefix of the others' names. A copy, also in another process, starts threads of
    its own.

    Examples:
        >>> pool, results = RowPool(3, "squares"), [0] * 5
        >>> pool.each(range(5), lambda row: row**2, results.__setitem__)
        >>> results
        [0, 1, 4, 9, 16]
    """

    def __init__(self, n: int, name: str) -> None:
        self._helpers = n - 1
        self._name = name
        self._pool = ThreadPoolExecutor(max(1, self._helpers), name)

    def __reduce__(self) -> tuple[type[RowPool], tuple[int, str]]:
        return RowPool, (self._helpers + 1, self._name)

    def each(
        self, rows: Iterable[int], work: Callable[[int], T], arrived: Callable[[int, T], object]
    ) -> None:
        """Call ``work`` on each row in any thread.

        The caller's thread calls ``arrived`` with each row and its result, as soon as possible.
        """
        waiting, results = deque(rows), deque[tuple[int, T]]()
        n_helpers = min(self._helpers, len(waiting) - 1)
        if n_helpers < 1:
            for row in waiting:
                arrived(row, work(row))
            return

        def work_on_next() -> bool:
            try:
                row = waiting.popleft()
            except IndexError:
                return False
            results.append((row, work(row)))
            return True

        def work_on_all() -> None:
            while work_on_next():
                pass

        def hand_over() -> None:
            while results:
                arrived(*results.popleft())

        helpers = [self._pool.submit(work_on_all) for _ in range(n_helpers)]
        interval = sys.getswitchinterval()
        try:
            # A thread that returns from MuJoCo waits up to this long for the GIL, by default 5 ms,
            # the time of several simulations.
            sys.setswitchinterval(2e-4)
            while work_on_next():
                hand_over()
        finally:
            wait(helpers)  # No helper works on after the call, even if it raises.
            sys.setswitchinterval(interval)
        for helper in helpers:
            helper.result()
        hand_over()

    def close(self) -> None:
        """End the helpers."""
        self._pool.shutdown()
