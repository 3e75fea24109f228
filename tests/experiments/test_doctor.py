"""The doctor, on this machine and on broken ones."""

import importlib.metadata
import os
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from packaging.requirements import Requirement
from PIL import Image

from bgpo_trl.experiments import doctor
from bgpo_trl.experiments.arguments import DoctorArguments
from bgpo_trl.scenes import SCENES, SimulationEnv
from tests.scenes.dot import Dot, scene

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(
    ("torch", "fits"), [("2.13.0", True), ("2.14.1+cu128", True), ("2.12.9", False), ("3.0", False)]
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
    assert f"torch {torch}" in problem and "tqdm missing" in problem
    program, verb, *packages = shlex.split(remedy)
    assert (program, verb) == ("pip", "install")
    assert [Requirement(package).name for package in packages] == ["torch", "tqdm"]


class Blind(Dot):
    def frame(self):
        return np.zeros((16, 24, 3), np.uint8)


@pytest.mark.parametrize(("make", "level", "slow"), [(Dot, "ok", 1e9), (Blind, "wrong", 0)])
def test_a_robot_is_drawn_and_measured(tmp_path, monkeypatch, capsys, make, level, slow):
    """Frames that take long are no fault, but there is a hint."""
    monkeypatch.setattr(doctor, "_SLOW", slow)
    monkeypatch.setitem(SCENES, "dot", scene(make))
    try:
        doctor.doctor(DoctorArguments(frame=tmp_path / "dot.png", scene="dot"))
    except SystemExit as stopped:
        assert (stopped.code, level) == (1, "wrong")
    lines = [line.split(maxsplit=2) for line in capsys.readouterr().out.splitlines()]
    found = {subject: (level, message) for level, subject, message in lines}
    assert found["dot"][0] == level
    assert "16 x 24, " in found["dot"][1]
    assert float(re.findall(r"(\d+) frames a second", found["dot"][1])[0]) > 0
    assert ("shadows" in found["dot"][1]) == (slow > 0)
    assert Image.open(tmp_path / "dot.png").size == (8 * 24, 8 * 16)


def test_a_robot_that_cannot_be_tried_is_not_wrong(monkeypatch):
    monkeypatch.setitem(SCENES, "dot", replace(scene(), make_env=None))
    assert doctor.check_robot(DoctorArguments(scene="dot")) == "it has no simulation to try"
    monkeypatch.setitem(SCENES, "dot", scene())
    monkeypatch.setattr("bgpo_trl.scenes.RobotEnv", SimulationEnv)
    assert "which is not moved" in doctor.check_robot(DoctorArguments(scene="dot"))


def test_a_full_disk_is_wrong(tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=1e8))
    with pytest.raises(OSError, match="make room"):
        doctor.check_disk()
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=40e9))
    assert doctor.check_disk().startswith(f"40.0 GB left in {Path.cwd()}")


@pytest.mark.parametrize(
    ("content", "backend", "cause"),
    [
        ("raise ImportError('libcudart is missing')\n", "egl", "libcudart"),
        (None, "vulkan", "'vulkan'"),
    ],
)
def test_a_broken_torch_and_an_unknown_backend_are_reported(tmp_path, content, backend, cause):
    if content is not None:
        (tmp_path / "torch").mkdir()
        (tmp_path / "torch" / "__init__.py").write_text(content)
    path = os.pathsep.join([str(tmp_path), str(ROOT)])
    process = subprocess.run(
        [sys.executable, "-m", "bgpo_trl", "doctor"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": path, "MUJOCO_GL": backend},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert process.returncode == 1
    assert "Traceback" not in process.stderr
    lines = [line.split(maxsplit=2) for line in process.stdout.splitlines()]
    found = {subject: (level, message) for level, subject, message in lines}
    assert [*found] == ["versions", "nico", "disk"]
    assert [subject for subject, (level, _) in found.items() if level == "wrong"] == ["nico"]
    assert cause in found["nico"][1]
