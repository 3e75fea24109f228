"""The doctor, on this machine and on broken ones."""

import importlib.metadata
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from bgpo_trl import doctor
from bgpo_trl.doctor import DoctorArguments, Finding
from bgpo_trl.scenes import SCENES
from tests.scenes.dot import Dot, scene

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize(
    ("found", "level"),
    [("2.13.0", "ok"), ("2.14.1+cu128", "ok"), ("2.12.9", "wrong"), ("3.0", "wrong")],
)
def test_a_dependency_outside_its_range_is_wrong(monkeypatch, found, level):
    monkeypatch.setattr(importlib.metadata, "requires", lambda _: ["torch>=2.13,<3"])
    monkeypatch.setattr(importlib.metadata, "version", lambda _: found)
    _, torch = doctor.check_versions()
    assert (torch.level, torch.subject) == (level, "torch")
    assert ("pip install 'torch" in torch.message) == (level == "wrong")


def test_extras_are_not_required_and_a_missing_dependency_is_wrong(monkeypatch):
    required = ["missing-package>=1", 'wandb>=0.31; extra == "wandb"']
    monkeypatch.setattr(importlib.metadata, "requires", lambda _: required)
    python, *others = doctor.check_versions()
    assert python.level == "ok"
    assert [(finding.level, finding.subject) for finding in others] == [
        ("wrong", "missing-package")
    ]


def test_a_frame_is_drawn_and_written(tmp_path):
    opengl, frame = doctor.check_frame(tmp_path / "frame.png")
    assert (opengl.level, frame.level) == ("ok", "ok")
    assert opengl.message.startswith(f"{os.environ['MUJOCO_GL']}, ")
    picture = np.asarray(Image.open(tmp_path / "frame.png"))
    assert picture.shape == (320, 640, 3)
    assert picture.std() > 10


@pytest.mark.parametrize("noise", [False, True])
def test_blank_frames_and_frames_that_never_change_are_wrong(monkeypatch, noise):
    frame = np.zeros((32, 64, 3), np.uint8)
    if noise:
        frame = np.random.default_rng(0).integers(255, size=frame.shape, dtype=np.uint8)
    monkeypatch.setattr("suites.nico.rendering.FrameRenderer.render", lambda *_: frame)
    _, found = doctor.check_frame()
    assert (found.level, found.subject) == ("wrong", "frame")


class Blind(Dot):
    def frame(self):
        return np.zeros((16, 24, 3), np.uint8)


@pytest.mark.parametrize(("make", "level"), [(Dot, "ok"), (Blind, "wrong")])
def test_another_robot_is_drawn_and_measured(tmp_path, monkeypatch, capsys, make, level):
    monkeypatch.setitem(SCENES, "dot", scene(make))
    monkeypatch.setattr(doctor, "check_frame", lambda path: [Finding("ok", "OpenGL", str(path))])
    try:
        doctor.doctor(DoctorArguments(frame=tmp_path / "dot.png", scene="dot"))
    except SystemExit as stopped:
        assert (stopped.code, level) == (1, "wrong")
    lines = [line.split(maxsplit=2) for line in capsys.readouterr().out.splitlines()]
    found = {subject: (level, message) for level, subject, message in lines}
    assert found["OpenGL"] == ("ok", "None")  # the picture is of the robot asked for
    assert found["dot"][0] == level
    assert found["dot"][1].startswith("16 x 24, ")
    assert float(found["frames/s"][1].partition(":")[0]) > 0
    assert Image.open(tmp_path / "dot.png").size == (8 * 24, 8 * 16)


def test_few_frames_a_second_are_noted(monkeypatch):
    (finding,) = doctor.check_frame_rate(seconds=0.05)
    assert float(finding.message.partition(":")[0]) > 0
    monkeypatch.setattr(doctor, "_FEW_FRAMES", 1e9)
    (finding,) = doctor.check_frame_rate(seconds=0.05)
    assert finding.level == "note"


@pytest.mark.parametrize(("free", "level"), [(40e9, "ok"), (3e9, "note"), (1e8, "wrong")])
def test_free_disk_space_decides_the_level(tmp_path, monkeypatch, free, level):
    usage = shutil.disk_usage(tmp_path)._replace(free=free)
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: usage)
    (finding,) = doctor.check_disk(tmp_path)
    assert finding.level == level
    monkeypatch.setattr(os, "access", lambda folder, mode: False)
    (finding,) = doctor.check_disk(tmp_path)
    assert finding.level == "wrong"


def test_a_check_that_raises_is_a_finding_and_the_others_go_on():
    def broken():
        yield Finding("ok", "half", "of it")
        raise RuntimeError("the first line\nand another")

    def fine():
        yield Finding("note", "b", "there")

    assert list(doctor.examine({"a": broken, "b": fine})) == [
        Finding("ok", "half", "of it"),
        Finding("wrong", "a", "RuntimeError: the first line"),
        Finding("note", "b", "there"),
    ]


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
    levels = {subject: (level, message) for level, subject, message in lines}
    assert "'vulkan'" in levels["OpenGL"][1]
    assert "libcudart is missing" in levels["frames/s"][1]
    assert [levels[name][0] for name in ("OpenGL", "frames/s", "threads")] == ["wrong"] * 3
    assert (levels["python"][0], levels["mujoco"][0]) == ("ok", "ok")
