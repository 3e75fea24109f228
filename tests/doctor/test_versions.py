"""Versions that are made up, and those of this machine."""

import importlib.metadata

import pytest
from bgpo_trl.doctor.finding import Finding

from bgpo_trl.doctor import versions


def told(finding: Finding) -> tuple[str, str]:
    assert "\n" not in str(finding)
    return finding.level, finding.told


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
    judged = told(versions.judge_version("torch", found, ">=2.13,<3", exact))
    assert judged[0] == level
    assert judged[1].startswith(message)


def test_an_extra_can_be_old_or_absent():
    options = {"wanted": ">=0.18,<1", "optional": True}
    absent = told(versions.judge_version("wandb", None, **options))
    assert absent == ("ok", "not installed, optional: pip install 'bgpo_trl[wandb]'")
    old = told(versions.judge_version("wandb", "0.17.9", **options))
    assert old == ("note", "0.17.9 is outside >=0.18,<1: pip install 'wandb>=0.18,<1'")


@pytest.mark.parametrize(("python", "level"), [("3.11.7", "ok"), ("3.13.0", "wrong")])
def test_python_has_a_range_too(python, level):
    assert versions.judge_python(python, "<3.13,>=3.11").level == level


def test_the_versions_of_constraints_are_read(tmp_path):
    assert versions.read_constraints(tmp_path / "missing.txt") == {}
    (tmp_path / "some.txt").write_text("# first\ntorch==2.13.0  # why\n\nnumpy==2.4.6\n")
    known = versions.read_constraints(tmp_path / "some.txt")
    assert known == {"torch": "2.13.0", "numpy": "2.4.6"}
    assert versions.read_constraints(versions.CONSTRAINTS)["mujoco"].startswith("3.")


def test_all_dependencies_and_the_extras_of_a_run_are_looked_at(tmp_path):
    installed = {"torch": "1.0", "mujoco": "4.0.0", "wandb": None}
    findings = list(
        versions.check_versions(
            lambda name: installed.get(name, "1.0.50"), tmp_path / "no constraints"
        )
    )
    found = {finding.what: finding for finding in findings}
    assert len(found) == len(findings)  # also if two extras name a package
    assert found.keys() >= {"python", "dm-control", "torch", "torchrl", "mujoco", "wandb", "ray"}
    assert not found.keys() & {"pytest", "ruff"}
    assert found["dm-control"].level == found["wandb"].level == "ok"
    assert found["torch"].level == found["mujoco"].level == "wrong"
    assert found["ray"].level == "note"


def test_a_package_that_is_not_installed_is_told(monkeypatch):
    def missing(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "distribution", missing)
    (finding,) = versions.check_versions()
    assert told(finding) == ("wrong", "not installed: pip install -c constraints.txt -e .")
