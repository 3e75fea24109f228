"""Checks of cores, GPUs and the disk."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

from bgpo_trl.doctor.finding import Finding

# Three checkpoints (two kept, one being written) of 10 seeds, 20,000 episodes of 22 steps and 662
# bytes a transition take 9 GB; three of `--preset quick`, 3 seeds and 900 episodes, 0.2 GB.
_ROOM_FOR_ALL, _ROOM_FOR_SOME = 10e9, 0.5e9


def check_device() -> Iterator[Finding]:
    """Check cores, threads and GPUs."""
    import torch

    from bgpo_trl.machine import usable_cores

    told = f"{usable_cores()} to use of {os.cpu_count()}, PyTorch takes {torch.get_num_threads()}"
    yield Finding("ok", "cores", f"{told} by itself and 1 in a run")
    devices = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    yield judge_gpu(devices, driver=shutil.which("nvidia-smi") is not None)


def judge_gpu(devices: Sequence[str], *, driver: bool) -> Finding:
    """Judge the GPUs that PyTorch sees, and whether there is a driver for more."""
    if devices:
        return Finding("ok", "device", f"cuda: {', '.join(devices)}")
    if driver:
        remedy = "for --device cuda install PyTorch's build for the driver's CUDA (pytorch.org)"
        return Finding("note", "device", f"cpu, though there is an NVIDIA driver: {remedy}")
    return Finding("ok", "device", "cpu; no GPU is needed")


def judge_disk(free: float, folder: Path) -> Finding:
    """Judge the free disk space (bytes) in the folder of the runs."""
    told = f"{free / 1e9:.1f} GB left in {folder}"
    if free < _ROOM_FOR_SOME:
        return Finding("wrong", "disk", f"{told}: make room, or go elsewhere with --out")
    if free < _ROOM_FOR_ALL:
        return Finding("note", "disk", f"{told}: enough for all but a run of --preset paper")
    return Finding("ok", "disk", told)


def check_disk(folder: Path | None = None) -> Iterator[Finding]:
    """Check the folder of the runs, by default the current one."""
    folder = Path.cwd() if folder is None else folder
    if not os.access(folder, os.W_OK):
        yield Finding("wrong", "disk", f"{folder} cannot be written: go elsewhere, or use --out")
        return
    yield judge_disk(shutil.disk_usage(folder).free, folder)
