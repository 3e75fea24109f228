"""Quotas of the machine are heeded, devices found or refused."""

import os

import pytest
import torch

from bgpo_trl.machine import choose_device, usable_cores

CORES = len(os.sched_getaffinity(0))


@pytest.mark.parametrize(
    ("quota", "cores"),
    [
        ("max 100000", CORES),
        ("100000 100000", 1),
        ("50000 100000", 1),  # half a core is still one to run on
        ("100000000 100000", CORES),
        ("nonsense", CORES),
    ],
)
def test_a_container_quota_bounds_the_number_of_cores(tmp_path, quota, cores):
    file = tmp_path / "cpu.max"
    file.write_text(quota)
    assert usable_cores(file) == cores


def test_affinity_bounds_the_number_of_cores(tmp_path):
    assert usable_cores(tmp_path / "missing") == CORES
    before = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, {min(before)})
        assert usable_cores(tmp_path / "missing") == 1
    finally:
        os.sched_setaffinity(0, before)


@pytest.mark.parametrize(("gpu", "device"), [(True, "cuda"), (False, "cpu")])
def test_auto_chooses_an_available_gpu(monkeypatch, gpu, device):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpu)
    assert choose_device() == torch.device(device)


def test_an_unavailable_device_is_refused():
    with pytest.raises(ValueError, match=r"^no device 'abacus' here \(.*\): use auto or cpu$"):
        choose_device("abacus")
    if not torch.cuda.is_available():
        with pytest.raises(ValueError, match=r"^no device 'cuda' here \(.*\): use auto or cpu$"):
            choose_device("cuda")
