"""Resources of the machine: usable cores, threads, and the device of the networks."""

from __future__ import annotations

import ctypes
import os
import sys
from pathlib import Path

import torch

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
