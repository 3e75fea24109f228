"""The doctor, on this machine and on broken ones."""

import importlib.metadata
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from packaging.requirements import Requirement
from PIL import Image

from bgpo_trl import doctor
from bgpo_trl.doctor import DoctorArguments
from bgpo_trl.scenes import SCENES
from tests.scenes.dot import Dot, scene

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize(
    ("torch", "fits"),
    [("2.13.0", True), ("2.14.1+cu128", True), ("2.12.9", False), ("3.0", False)],
)
def test_all_that_is_missing_or_does_not_fit_is_installed_by_one_line(monkeypatch, torch, fits):
    """Extras are not required."""
    installed = {"numpy": "2.0", "torch": torch} | ({"tqdm": "4.66"} if fits else {})

    def version(name):
        if name not in installed:
            raise importlib.metadata.PackageNotFoundError(name)
        return installed[name]

    required = ["numpy>=2.0", "torch>=2.13,<3", "tqdm>=4.66", 'wandb>=99; extra == "wandb"']
    monkeypatch.setattr(importlib.metadata, "requires", lambda _: required)
    monkeypatch.setattr(importlib.metadata, "version", version)
    if fits:
        assert f"torch {torch}" in doctor.check_versions()
        return
    with pytest.raises(RuntimeError) as raised:
        doctor.check_versions()
    problem, remedy = str(raised.value).split(": ")
    assert f"torch is {torch}" in problem and "tqdm" in problem
    program, verb, *packages = shlex.split(remedy)
    assert (program, verb) == ("pip", "install")
    assert [Requirement(package).name for package in packages] == ["torch", "tqdm"]


def test_a_frame_is_drawn_and_written(tmp_path):
    assert doctor.check_frame(tmp_path / "frame.png").startswith(f"{os.environ['MUJOCO_GL']}, ")
    picture = np.asarray(Image.open(tmp_path / "frame.png"))
    assert picture.shape == (320, 640, 3)
    assert picture.std() > 10


@pytest.mark.parametrize("noise", [False, True])
def test_blank_frames_and_frames_that_never_change_are_wrong(monkeypatch, noise):
    frame = np.zeros((32, 64, 3), np.uint8)
    if noise:
        frame = np.random.default_rng(0).integers(255, size=frame.shape, dtype=np.uint8)
    monkeypatch.setattr("suites.nico.rendering.FrameRenderer.render", lambda *_: frame)
    with pytest.raises(RuntimeError, match="MUJOCO_GL"):
        doctor.check_frame()


class Blind(Dot):
    def frame(self):
        return np.zeros((16, 24, 3), np.uint8)


@pytest.mark.parametrize(("make", "level"), [(Dot, "ok"), (Blind, "wrong")])
def test_another_robot_is_drawn_and_measured(tmp_path, monkeypatch, capsys, make, level):
    monkeypatch.setitem(SCENES, "dot", scene(make))
    try:
        doctor.doctor(DoctorArguments(frame=tmp_path / "dot.png", scene="dot"))
    except SystemExit as stopped:
        assert (stopped.code, level) == (1, "wrong")
    lines = [line.split(maxsplit=2) for line in capsys.readouterr().out.splitlines()]
    found = {subject: (level, message) for level, subject, message in lines}
    assert "OpenGL" not in found  # of NICO
    assert found["dot"][0] == level
    assert "16 x 24, " in found["dot"][1]
    assert float(found["frames/s"][1].partition(":")[0]) > 0
    assert Image.open(tmp_path / "dot.png").size == (8 * 24, 8 * 16)


def test_free_disk_space_decides_the_level(tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)
    for free, error in ((3e9, doctor.Limited), (1e8, OSError)):
        monkeypatch.setattr(shutil, "disk_usage", lambda _, free=free: usage._replace(free=free))
        with pytest.raises(error):
            doctor.check_disk(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=40e9))
    assert doctor.check_disk(tmp_path) == f"40.0 GB left in {tmp_path}"


def test_a_broken_torch_and_an_unknown_backend_are_each_reported(tmp_path):
    (tmp_path / "torch").mkdir()
    (tmp_path / "torch" / "__init__.py").write_text("raise ImportError('libcudart is missing')\n")
    path = os.pathsep.join([str(tmp_path), str(ROOT)])
    process = subprocess.run(
        [sys.executable, "-m", "bgpo_trl", "doctor"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": path, "MUJOCO_GL": "vulkan"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert process.returncode == 1
    assert "Traceback" not in process.stderr
    lines = [line.split(maxsplit=2) for line in process.stdout.splitlines()]
    found = {subject: (level, message) for level, subject, message in lines}
    assert [*found] == ["versions", "OpenGL", "frames/s", "threads", "disk"]
    assert [level for level, _ in found.values()][:4] == ["ok", "wrong", "wrong", "wrong"]
    assert "'vulkan'" in found["OpenGL"][1]
    assert "libcudart is missing" in found["threads"][1]


def test_tensordict_is_imported_before_the_first_frame_is_drawn():
    """With torch for CUDA it imports Triton, which crashes once Mesa has loaded its LLVM."""
    code = (
        "import sys\n"
        "from bgpo_trl.doctor import check_frame\n"
        "from suites.nico.rendering import FrameRenderer\n"
        "make = FrameRenderer.__init__\n"
        "def checked(*args):\n"
        "    print('tensordict' in sys.modules)\n"
        "    make(*args)\n"
        "FrameRenderer.__init__ = checked\n"
        "assert 'tensordict' not in sys.modules\n"
        "check_frame()\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert (done.returncode, done.stdout) == (0, "True\n"), done.stderr
