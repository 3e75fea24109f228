"""``suites`` is a namespace package, which several projects can share."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("name", ["notes.txt", "__init__.py"])
def test_a_folder_of_that_name_in_the_working_directory(tmp_path, name):
    """Only a package of that name hides ours, which ends in one line with the remedy."""
    (tmp_path / "suites").mkdir()
    (tmp_path / "suites" / name).touch()
    process = subprocess.run(  # Without site-packages, where an editable install would be found.
        [sys.executable, "-S", "-c", "import bgpo_trl; print(bgpo_trl.opengl.__name__)"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    if name == "__init__.py":
        line = process.stderr.splitlines()[-1]
        assert line.startswith("ImportError")
        assert "hides ours: remove its __init__.py" in line
    else:
        assert (process.stdout, process.stderr) == ("suites.opengl\n", "")


def test_the_wheel_leaves_room_for_suites_of_other_projects(tmp_path):
    copy, wheels = tmp_path / "copy", tmp_path / "wheels"
    for name in ("bgpo_trl", "suites"):
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, copy / name)
    wheels.mkdir()
    # The hook that pip calls, without the network that its isolated environment needs.
    build = f"from setuptools.build_meta import build_wheel; build_wheel({str(wheels)!r})"
    subprocess.run([sys.executable, "-c", build], cwd=copy, check=True, capture_output=True)
    (wheel,) = wheels.iterdir()
    installed = tmp_path / "site-packages"
    with zipfile.ZipFile(wheel) as archive:
        names = [name for name in archive.namelist() if name.startswith("suites/")]
        archive.extractall(installed)
    assert {name for name in names if name.count("/") == 1} == {"suites/opengl.py"}
    assert {"suites/nico/__init__.py", "suites/nico/nico.xml", "suites/nico/py.typed"} <= {*names}
    assert (installed / "bgpo_trl" / "weights" / "nico.safetensors").exists()

    (installed / "suites" / "other").mkdir()
    (installed / "suites" / "other" / "__init__.py").touch()
    # Both are light; `suites.nico` itself would import dm_control.
    use = "import suites.opengl, suites.other; print(*suites.__path__)"
    environment = {**os.environ, "PYTHONPATH": str(installed)}
    command = [sys.executable, "-c", use]
    found = subprocess.check_output(command, cwd="/", env=environment, text=True)
    assert str(installed) in found
