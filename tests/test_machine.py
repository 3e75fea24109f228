"""Quotas of the machine are heeded, devices found or refused, rows shared between threads."""

import os
import pickle
import platform
import subprocess
import sys
import threading

import pytest
import torch

from bgpo_trl.machine import RowPool, choose_device, has_bfloat16, usable_cores

CORES = len(os.sched_getaffinity(0))


@pytest.mark.parametrize(
    ("quota", "cores"),
    [
        ("max 100000", CORES),
        ("50000 100000", 1),  # half a core is still one to run on
        ("100000000 100000", CORES),
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


def test_auto_chooses_an_available_gpu(monkeypatch):
    for gpu, device in ((True, "cuda"), (False, "cpu")):
        monkeypatch.setattr(torch.cuda, "is_available", lambda gpu=gpu: gpu)
        assert choose_device() == torch.device(device)


FAULTS = """
import resource, threading
import torch
from bgpo_trl.machine import keep_freed_memory

def use():
    for _ in range(20):
        [torch.ones(2**20) + i for i in range(3)]

def count():
    use()  # what is used for the first time has to be mapped
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    use()
    print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)

for prepare in (lambda: None, keep_freed_memory):
    prepare()
    thread = threading.Thread(target=count)  # as the updates of a training run
    thread.start()
    thread.join()
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other libraries keep memory or not")
def test_freed_memory_that_is_kept_is_used_again_without_page_faults():
    printed = subprocess.check_output([sys.executable, "-c", FAULTS], text=True)
    returned, kept = map(int, printed.split())
    assert kept < returned / 100


@pytest.fixture(params=[1, 3])
def threads(request):
    threads = RowPool(request.param, "test")
    yield threads
    threads.close()


def test_each_row_is_computed_once_and_received_by_the_calling_thread(threads):
    rows, places = list(range(3, 15)), set()

    def arrived(row, result):
        places.add(threading.current_thread())
        results.append((row, result))

    for _ in range(2):
        results: list[tuple[int, int]] = []
        threads.each(rows, lambda row: row**2, arrived)
        assert sorted(results) == [(row, row**2) for row in rows]
    threads.each([], lambda row: row, arrived)
    assert places == {threading.current_thread()}


def test_an_error_in_a_thread_is_raised_after_all_have_ended(threads):
    interval, working = sys.getswitchinterval(), []

    def work(row):
        working.append(row)
        try:
            if row == 7:
                raise ValueError("row 7")
        finally:
            working.remove(row)

    with pytest.raises(ValueError, match="row 7"):
        threads.each(range(12), work, lambda row, result: None)
    assert not working
    assert sys.getswitchinterval() == interval


def test_a_copy_has_its_own_threads(threads):
    copy, results = pickle.loads(pickle.dumps(threads)), {}
    threads.close()
    copy.each(range(5), lambda row: row**2, results.__setitem__)
    assert results == {row: row**2 for row in range(5)}
    copy.close()


@pytest.mark.parametrize("there", [True, False])
def test_bfloat16_is_asked_of_the_device(monkeypatch, there):
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: there)
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation: not there)
    found = [has_bfloat16(torch.device(kind)) for kind in ("cpu", "cuda", "mps")]
    assert found == [there, not there, True]
