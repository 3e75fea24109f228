"""The doctor: each ill by itself, made up; and all of it, on this machine and on a broken one."""

import importlib.metadata
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from bgpo_trl import doctor
from bgpo_trl.doctor import Finding
from bgpo_trl.encoders import pretrained

ROOT = Path(__file__).parents[1]
GB = 10**9


def told(finding: Finding) -> tuple[str, str]:
    assert "\n" not in str(finding)
    return finding.level, finding.told


# ---- versions


@pytest.mark.parametrize(
    ("found", "exact", "level", "message"),
    [
        ("2.13.0", None, "ok", "2.13.0"),
        ("2.14.1+cu128", None, "ok", "2.14.1+cu128"),
        ("2.13.0+cpu", "2.13.0", "ok", "2.13.0+cpu"),
        ("2.14.1", "2.13.0", "note", "2.14.1, known to work is 2.13.0; if in doubt: pip install "),
        ("2.12.9", "2.13.0", "wrong", "2.12.9 is outside >=2.13,<3: pip install torch==2.13.0"),
        ("3.0.0", None, "wrong", "3.0.0 is outside >=2.13,<3: pip install 'torch>=2.13,<3'"),
        (None, None, "wrong", "not installed: pip install 'torch>=2.13,<3'"),
    ],
)
def test_a_dependency_is_judged_by_its_range_and_by_what_is_known_to_work(
    found, exact, level, message
):
    judged = told(doctor.judge_version("torch", found, ">=2.13,<3", exact))
    assert judged[0] == level
    assert judged[1].startswith(message)


def test_an_extra_can_be_old_or_absent():
    options = {"wanted": ">=0.18,<1", "optional": True}
    absent = told(doctor.judge_version("wandb", None, **options))
    assert absent == ("ok", "not installed, optional: pip install 'bgpo_trl[wandb]'")
    old = told(doctor.judge_version("wandb", "0.17.9", **options))
    assert old == ("note", "0.17.9 is outside >=0.18,<1: pip install 'wandb>=0.18,<1'")


@pytest.mark.parametrize(("python", "level"), [("3.11.7", "ok"), ("3.13.0", "wrong")])
def test_python_has_a_range_too(python, level):
    assert doctor.judge_python(python, "<3.13,>=3.11").level == level


def test_the_versions_of_constraints_are_read(tmp_path):
    assert doctor.read_constraints(tmp_path / "missing.txt") == {}
    (tmp_path / "some.txt").write_text("# first\ntorch==2.13.0  # why\n\nnumpy==2.4.6\n")
    known = doctor.read_constraints(tmp_path / "some.txt")
    assert known == {"torch": "2.13.0", "numpy": "2.4.6"}
    assert doctor.read_constraints(doctor.CONSTRAINTS)["mujoco"].startswith("3.")


def test_all_dependencies_and_the_extras_of_a_run_are_looked_at(tmp_path):
    versions = {"torch": "1.0", "mujoco": "4.0.0", "wandb": None}
    found = {
        finding.what: finding
        for finding in doctor.check_versions(
            lambda name: versions.get(name, "1.0.50"), tmp_path / "no constraints"
        )
    }
    assert found.keys() >= {"python", "dm-control", "torch", "torchrl", "mujoco", "wandb", "ray"}
    assert not found.keys() & {"pytest", "ruff"}
    assert found["dm-control"].level == found["wandb"].level == "ok"
    assert found["torch"].level == found["mujoco"].level == "wrong"
    assert found["ray"].level == "note"


def test_a_package_that_is_not_installed_is_told(monkeypatch):
    def missing(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "distribution", missing)
    (finding,) = doctor.check_versions()
    assert told(finding) == ("wrong", "not installed: pip install -c constraints.txt -e .")


# ---- frames


def test_frames_are_shown_not_to_be_blank_and_to_follow_the_arm():
    frame = np.random.default_rng(0).integers(0, 255, (32, 64, 3), np.uint8)
    moved = frame.copy()
    moved[3, 4:7] ^= 1
    seen = told(doctor.judge_frames(frame, moved))
    assert seen[0] == "ok"
    assert seen[1].endswith(" 3 pixels change as the arm moves")
    assert told(doctor.judge_frames(frame, frame.copy()))[1].startswith("stays the same when the")
    blank = np.full_like(frame, 7)
    level, message = told(doctor.judge_frames(blank, moved))
    assert level == "wrong"
    assert message.startswith("blank, 1 colours: try MUJOCO_GL=egl")


def test_a_real_frame_is_drawn_and_written(tmp_path):
    opengl, frame, written = doctor.check_frame(tmp_path / "frame.png")
    assert {opengl.level, frame.level, written.level} == {"ok"}
    assert opengl.told.startswith(f"{os.environ['MUJOCO_GL']}, ")
    assert "unknown" not in opengl.told
    picture = np.asarray(Image.open(tmp_path / "frame.png"))
    assert picture.shape == (320, 640, 3)
    assert picture.std() > 10


def test_a_renderer_that_draws_nothing_is_found_out(monkeypatch):
    monkeypatch.setattr(
        "suites.nico.rendering.FrameRenderer.render",
        lambda self, data, out=None: np.zeros((32, 64, 3), np.uint8),
    )
    assert [finding.level for finding in doctor.check_frame()] == ["ok", "wrong"]


# ---- speed, machine


def test_few_frames_are_noted():
    assert told(doctor.judge_frame_rate(400, 900, 4)) == ("ok", "400 on one core, 900 on 4")
    level, message = told(doctor.judge_frame_rate(12, 20, 2))
    assert level == "note"
    assert message.startswith("12 on one core, 20 on 2: few; is the machine busy")


def test_rates_are_calls_a_second(monkeypatch):
    clock = iter(np.arange(0, 100, 0.25))
    monkeypatch.setattr(doctor.time, "perf_counter", lambda: float(next(clock)))
    calls = []
    rate = doctor._rate(lambda: calls.append(1), seconds=2.0)
    assert rate == pytest.approx((len(calls) - 1) / 2.0)  # the first call is not timed
    assert len(calls) > 5


def test_speed_is_measured():
    (frames,) = doctor.check_frame_rate(seconds=0.05)
    assert frames.level in ("ok", "note")
    weights, updates = doctor.check_update_rate(seconds=0.05)
    assert told(weights) == ("ok", "encoders and 3,600 embedded demonstrations")
    assert int(updates.told.split(",")[0]) > 0


def test_weights_that_do_not_load_are_told_with_their_remedy(monkeypatch, tmp_path):
    path = tmp_path / "nico.safetensors"
    monkeypatch.setattr(pretrained, "default_weights", lambda: path)
    (finding,) = doctor.examine({"updates/s": doctor.check_update_rate})
    assert finding.level == "wrong"
    assert f"no encoder weights at {path}: train new ones" in told(finding)[1]


@pytest.mark.parametrize(
    ("free", "level", "message"),
    [
        (40 * GB, "ok", "40.0 GB left in runs"),
        (3 * GB, "note", "3.0 GB left in runs: enough for all but a run of --preset paper"),
        (GB // 10, "wrong", "0.1 GB left in runs: make room, or go elsewhere with --out"),
    ],
)
def test_room_on_the_disk_is_judged(free, level, message):
    assert told(doctor.judge_disk(free, Path("runs"))) == (level, message)


def test_the_disk_is_looked_at_where_runs_go(tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)._replace(free=GB // 10)
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: usage)
    (finding,) = doctor.check_disk(tmp_path)
    assert finding.level == "wrong"
    monkeypatch.setattr(os, "access", lambda folder, mode: False)
    (finding,) = doctor.check_disk(tmp_path)
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
    judged = told(doctor.judge_gpu(devices, driver=driver))
    assert judged[0] == level
    assert judged[1].startswith(message)


def test_cores_and_threads_are_told():
    cores, device = doctor.check_device()
    assert cores.told.startswith(f"{len(os.sched_getaffinity(0))} to use of")
    assert f"PyTorch takes {torch.get_num_threads()} by itself" in cores.told
    assert device.what == "device"


# ---- all of it


def test_a_check_that_breaks_is_a_finding_and_the_others_go_on():
    def broken():
        yield Finding("ok", "half", "of it")
        raise RuntimeError("the first line\nand another")

    def fine():
        yield Finding("note", "b", "there")

    findings = list(doctor.examine({"a": broken, "b": fine}))
    assert [finding.level for finding in findings] == ["ok", "wrong", "note"]
    assert findings[1].what == "a"
    assert "RuntimeError: the first line)" in told(findings[1])[1]


@pytest.mark.parametrize(
    ("levels", "status", "sum_up"),
    [
        (["ok", "ok"], 0, "all is well"),
        (["ok", "note"], 0, "0 wrong, 1 to note"),
        (["note", "wrong", "wrong"], 1, "2 wrong, 1 to note"),
    ],
)
def test_only_what_is_wrong_makes_the_exit_status(monkeypatch, capsys, levels, status, sum_up):
    found = [Finding(level, "this", "that") for level in levels]
    monkeypatch.setattr(doctor, "examine", lambda checks: iter(found))
    assert doctor.main([]) == status
    *lines, blank, last = capsys.readouterr().out.splitlines()
    assert [line.split() for line in lines] == [[level, "this", "that"] for level in levels]
    assert len({line.index("that") for line in lines}) == 1  # one below the other
    assert (blank, last) == ("", sum_up)


def run_doctor(folder: Path, **environment: str) -> dict[str, str]:
    """Runs it as a person would; returns its lines by what they are about, and ``status``."""
    process = subprocess.run(
        [sys.executable, "-m", "bgpo_trl.doctor"],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert "Traceback" not in process.stdout + process.stderr
    lines = [line.split(maxsplit=2) for line in process.stdout.splitlines()[:-2]]
    return {line[1]: f"{line[0]} {line[2]}" for line in lines} | {"status": str(process.returncode)}


def test_it_outlives_a_broken_torch_and_a_backend_that_there_is_not(tmp_path):
    """Nothing but what is broken is wrong, whatever imports it."""
    (tmp_path / "torch").mkdir()
    (tmp_path / "torch" / "__init__.py").write_text("raise ImportError('libcudart is missing')\n")
    path = os.pathsep.join([str(tmp_path), str(ROOT)])
    lines = run_doctor(tmp_path, PYTHONPATH=path, MUJOCO_GL="vulkan")
    assert lines["status"] == "1"
    assert lines["OpenGL"].startswith(
        "wrong MUJOCO_GL is 'vulkan', which is not an OpenGL backend: "
    )
    for what in ("frames/s", "updates/s", "device"):
        assert lines[what].startswith("wrong cannot be checked (ImportError: libcudart is missing)")
    assert lines["python"].startswith("ok ")
    assert lines["mujoco"].startswith(("ok ", "note "))
    assert not list(tmp_path.glob("runs*"))


@pytest.mark.slow
def test_this_machine_is_fit(tmp_path):
    lines = run_doctor(tmp_path)
    assert lines["status"] == "0"
    assert {"frames/s", "updates/s", "weights", "disk", "OpenGL", "frame"} <= lines.keys()
