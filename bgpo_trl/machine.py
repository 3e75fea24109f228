"""Resources of the machine: cores, threads, freed memory, devices, and signals that end a run."""

from __future__ import annotations

import ctypes
import os
import sys
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import TypeVar

import torch

T = TypeVar("T")
# Options of mallopt (malloc.h), and bytes.
_KEEP_FREED = {
    -1: 2**30,  # M_TRIM_THRESHOLD: free memory that is kept
    -2: 2**26,  # M_TOP_PAD: memory that is requested at once
    -3: 2**25,  # M_MMAP_THRESHOLD: size from which memory is mapped for itself; the largest allowed
}


def usable_cores(quota: str | Path = "/sys/fs/cgroup/cpu.max") -> int:
    """Return the number of cores that this process may use, at least 1.

    Respects the process's affinity (``taskset``, Slurm) and a container's quota, a file with quota
    and period (us) such as ``"200000 100000"`` or ``"max 100000"``.
    """
    if hasattr(os, "sched_getaffinity"):
        cores = len(os.sched_getaffinity(0))
    else:
        cores = os.cpu_count() or 1
    try:
        allowed, period = Path(quota).read_text().split()
        cores = min(cores, round(int(allowed) / int(period)))
    except (OSError, ValueError):  # Not Linux, or no quota.
        pass
    return max(1, cores)


def set_threads(threads: int) -> None:
    """Set the number of PyTorch's threads; raise ``ValueError`` if it is below 1."""
    if threads < 1:
        raise ValueError(f"threads must be at least 1, got {threads}: small networks need only 1")
    torch.set_num_threads(threads)


def keep_freed_memory() -> None:
    """Have glibc keep freed memory for the next tensors, up to 1 GB, for the whole process.

    By default it returns freed memory to the operating system between two operations, so that an
    update of ten seeds spends a tenth of its time on page faults. Without glibc, nothing happens.
    """
    if not sys.platform.startswith("linux"):
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:  # The C library is not musl.
        for option, size in _KEEP_FREED.items():
            mallopt(option, size)


def choose_device(name: str = "auto") -> torch.device:
    """Return the device of the networks; simulations always run on the CPU.

    ``"auto"`` is a CUDA GPU if available, else the CPU.

    Raises:
        ValueError: If the device is not available.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:  # AssertionError: no CUDA.
        reason = str(error).splitlines()[0].partition(". ")[0]
        raise ValueError(f"no device {name!r} here ({reason}): use auto or cpu") from error
    return device


def has_bfloat16(device: torch.device) -> bool:
    """Return whether a CPU or a GPU of CUDA has instructions for bfloat16, rather than emulates it.

    Of CPUs, those of x86 with AVX-512 are known to. Other kinds of devices are believed to.
    """
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return device.type != "cpu" or torch.cpu._is_avx512_bf16_supported()


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
