"""Damaged run directories: one line each, from every command that reads them, and no change."""

import json
import os
import re
import shutil
import warnings
from functools import partial

import pytest
from aftermath import AftermathArguments, aftermath
from looking import looking
from one_shot import OneShotArguments, one_shot
from shared import TrainedArguments

from bgpo_trl.experiments.report import ReportArguments, report
from bgpo_trl.experiments.watch import WatchArguments, watch
from suites import nico
from tests.helpers import CHECKPOINTS, contents, edit, put_checkpoint

TASKS = nico.PAPER_TASKS
FINAL = "seed,demonstrations,task,episodes,success,task_inference\n"


@pytest.fixture
def run(run_of):
    """A finished run with final tests and a summary."""
    run = run_of("bgpo")
    rows = [
        f"{seed},{kind},{task},20,0.5,0.25\n"
        for kind in ("seen", "held-out")
        for task in TASKS
        for seed in (3, 8)
    ]
    (run / "final.csv").write_text(FINAL + "".join(rows))
    summary = {"commit": "c", "command": "python", "episodes": 10, "nodes": [3, 4]}
    (run / "summary.json").write_text(json.dumps(summary))
    return run


def check_refused(call):
    """Checks that a call ends in one line with a remedy, and without a warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        with pytest.raises((ValueError, OSError, RuntimeError)) as raised:
            call()
    message = str(raised.value)
    assert message.isprintable() and len(message) < 900
    assert re.search(r": (let|put|name|resume|remove|use|choose|correct|only|there is no)", message)


def settings(**changes):
    return lambda run: edit(run / "config.json", **changes)


def write(name, content):
    return lambda run: (run / name).write_bytes(content)


def damages(name):
    """Kinds of damage that any file may have."""
    return {
        f"{name} missing": lambda run: (run / name).unlink(),
        f"{name} empty": write(name, b""),
        f"{name} not text": write(name, b"\xff\xfe\x00" * 20),
        f"{name} a folder": lambda run: ((run / name).unlink(), (run / name).mkdir()),
        f"{name} of something else": write(name, b'{"port": 80}'),
    }


REPORTED = {
    **damages("eval.csv"),
    **damages("final.csv"),
    **damages("config.json"),
    **damages("summary.json"),
    "starts of other tasks": settings(task_starts=[0, 1]),
    "tasks by number": settings(tasks=[1, 2, 3]),
    "nodes in words": lambda run: edit(run / "summary.json", nodes="many"),
}
# These files are optional, and nothing in the summary is required.
for _name in ("final.csv missing", "summary.json missing", "summary.json of something else"):
    del REPORTED[_name]


@pytest.mark.parametrize("damage", REPORTED)
def test_a_damaged_run_is_not_reported(run, damage):
    REPORTED[damage](run)
    before = contents(run)
    check_refused(lambda: report(ReportArguments((run,))))
    assert contents(run) == before


def test_final_tests_and_summary_are_optional_in_a_report(run):
    text = report(ReportArguments((run,)))
    assert "nan" not in text
    assert "| one for all |  | 25.00 | 25 25 | 3 4 |" in text
    assert "- `c`, `python`" in text
    (run / "final.csv").unlink()
    report(ReportArguments((run,)))
    (run / "summary.json").unlink()
    with pytest.raises(ValueError, match=r"has no summary \(.*\): let them finish"):
        report(ReportArguments((run,)))  # it can be resumed, and has a summary then
    shutil.rmtree(run / "checkpoint")
    text = report(ReportArguments((run,)))
    assert "## GWR-B" not in text and "## Cost" in text


LOADED = {
    **damages("config.json"),
    "a checkpoint of something else": partial(put_checkpoint, content=CHECKPOINTS["a list"]),
    "edited settings": settings(eval_episodes=7),
    "no starts": settings(task_starts=[]),
}
COMMANDS = {
    "bgpo_trl.experiments.watch.demonstrate": (watch, WatchArguments),
    "one_shot.measure": (one_shot, OneShotArguments),
    "looking.measure_looking": (looking, TrainedArguments),
    "aftermath.episodes_of": (aftermath, AftermathArguments),
}
"""Commands that test policies, by the function that begins the work."""


@pytest.mark.parametrize("damage", LOADED)
def test_a_damaged_run_is_neither_filmed_nor_tested(run, damage, tmp_path):
    LOADED[damage](run)
    for command, arguments in COMMANDS.values():
        check_refused(lambda c=command, a=arguments: c(a(run=run, out=tmp_path / "out")))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("out", ["here", "here/new"])
def test_a_read_only_folder_is_refused_before_the_work(run, out, tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    # For root, permissions would not make it so.
    monkeypatch.setattr(os, "access", lambda path, mode: path != tmp_path / "here")
    for work, (command, arguments) in COMMANDS.items():
        monkeypatch.setattr(work, lambda *_: pytest.fail("has begun"))
        with pytest.raises(PermissionError, match=r"read-only.*--out"):
            command(arguments(run=run, out=tmp_path / out))
    with pytest.raises(PermissionError, match=r"read-only.*--out"):
        report(ReportArguments((run,), out=tmp_path / "here"))
    assert not list((tmp_path / "here").iterdir())
