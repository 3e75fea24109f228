"""The commit and the command that are stored with results."""

import shlex
import sys

import pytest

from bgpo_trl.runs.provenance import command


@pytest.mark.parametrize(
    ("given", "kept"),
    [
        (["--out", "runs/own"], ["--out", "runs/own"]),
        (["--out", "{here}/runs/own"], ["--out", "runs/own"]),
        (["--out={here}/runs/own"], ["--out=runs/own"]),
        (["--bank", "/data/me/own.bank"], ["--bank", ".../own.bank"]),
        (["--bank=/data/me/own.bank"], ["--bank=.../own.bank"]),
        (["../own", "-/5", "and/or", "a name"], ["../own", "-/5", "and/or", "a name"]),
    ],
)
def test_a_command_is_kept_without_the_folders_of_this_machine(tmp_path, monkeypatch, given, kept):
    monkeypatch.chdir(tmp_path)
    given = [word.format(here=tmp_path) for word in given]
    monkeypatch.setattr(sys, "argv", ["-m", "bgpo_trl", *given])
    assert shlex.split(command()) == ["python", "-m", "bgpo_trl", *kept]
