"""The commit and the command that are stored with results."""

import shlex
import sys

from bgpo_trl.runs.provenance import command


def test_a_command_is_kept_without_the_folders_of_this_machine(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    kept = {word: word for word in ("-m", "bgpo_trl", "runs/own", "../own", "-/5", "and/or", "a b")}
    kept |= {f"{tmp_path}/runs/own": "runs/own", f"--out={tmp_path}/runs/own": "--out=runs/own"}
    kept |= {"/data/me/own.bank": ".../own.bank", "--bank=/data/me/own.bank": "--bank=.../own.bank"}
    monkeypatch.setattr(sys, "argv", [*kept])
    assert shlex.split(command()) == ["python", *kept.values()]
