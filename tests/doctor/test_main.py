"""All of it, on this machine and on a broken one."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from bgpo_trl.doctor.finding import Finding
from bgpo_trl.doctor.speed import check_update_rate

from bgpo_trl.doctor import __main__ as command
from bgpo_trl.encoders import pretrained

ROOT = Path(__file__).parents[2]


def told(finding: Finding) -> tuple[str, str]:
    assert "\n" not in str(finding)
    return finding.level, finding.told


def test_weights_that_do_not_load_are_told_with_their_remedy(monkeypatch, tmp_path):
    path = tmp_path / "nico.safetensors"
    monkeypatch.setattr(pretrained, "default_weights", lambda tasks: path)
    (finding,) = command.examine({"updates/s": check_update_rate})
    assert finding.level == "wrong"
    assert f"no encoder weights at {path}: train new ones" in told(finding)[1]


def test_a_check_that_breaks_is_a_finding_and_the_others_go_on():
    def broken():
        yield Finding("ok", "half", "of it")
        raise RuntimeError("the first line\nand another")

    def fine():
        yield Finding("note", "b", "there")

    findings = list(command.examine({"a": broken, "b": fine}))
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
    monkeypatch.setattr(command, "examine", lambda checks: iter(found))
    assert command.main([]) == status
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
