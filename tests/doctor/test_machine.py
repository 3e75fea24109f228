import os
import shutil
from pathlib import Path

import pytest
import torch
from bgpo_trl.doctor.finding import Finding

from bgpo_trl.doctor import machine

GB = 10**9


def told(finding: Finding) -> tuple[str, str]:
    assert "\n" not in str(finding)
    return finding.level, finding.told


@pytest.mark.parametrize(
    ("free", "level", "message"),
    [
        (40 * GB, "ok", "40.0 GB left in runs"),
        (3 * GB, "note", "3.0 GB left in runs: enough for all but a run of --preset paper"),
        (GB // 10, "wrong", "0.1 GB left in runs: make room, or go elsewhere with --out"),
    ],
)
def test_room_on_the_disk_is_judged(free, level, message):
    assert told(machine.judge_disk(free, Path("runs"))) == (level, message)


def test_the_disk_is_looked_at_where_runs_go(tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)._replace(free=GB // 10)
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: usage)
    (finding,) = machine.check_disk(tmp_path)
    assert finding.level == "wrong"
    monkeypatch.setattr(os, "access", lambda folder, mode: False)
    (finding,) = machine.check_disk(tmp_path)
    assert told(finding) == ("wrong", f"{tmp_path} cannot be written: go elsewhere, or use --out")


@pytest.mark.parametrize(
    ("devices", "driver", "level", "message"),
    [
        ([], False, "ok", "cpu; no GPU is needed"),
        (["Some GPU"], True, "ok", "cuda: Some GPU"),
        ([], True, "note", "cpu, though there is an NVIDIA driver: for --device cuda install "),
    ],
)
def test_gpus_are_judged(devices, driver, level, message):
    judged = told(machine.judge_gpu(devices, driver=driver))
    assert judged[0] == level
    assert judged[1].startswith(message)


def test_cores_and_threads_are_told():
    cores, device = machine.check_device()
    assert cores.told.startswith(f"{len(os.sched_getaffinity(0))} to use of")
    assert f"PyTorch takes {torch.get_num_threads()} by itself" in cores.told
    assert device.what == "device"
