"""Wrong command lines: one line or tyro's box, and nothing is written."""

import contextlib
import json
import os
import runpy
import signal
import subprocess
import sys
import warnings
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from bgpo_trl import __main__ as bgpo
from bgpo_trl.configs import BGPOConfig
from bgpo_trl.experiments.arguments import Arguments, ProbesArguments, RecordArguments
from bgpo_trl.experiments.command_line import command_line
from bgpo_trl.interrupts import interrupts_wait
from suites import opengl
from tests.helpers import contents

ROOT = Path(__file__).parents[2]


@pytest.fixture
def folder(tiny, tmp_path, monkeypatch):
    """The current folder, with a file, an empty folder and runs that are not whole."""
    monkeypatch.chdir(tmp_path)
    for name in ("empty", "run", "damaged"):
        (tmp_path / name).mkdir()
    (tmp_path / "file").touch()
    config = {"name": "bgpo", "schedule": "practised", "episodes": 50, "eval_every": 1}
    config |= {"seeds": [0], "tasks": ["grasp_glass"], "task_starts": [0]}
    (tmp_path / "run" / "config.json").write_text(json.dumps(config))
    (tmp_path / "damaged" / "config.json").write_text('{"episodes": ')
    return tmp_path


def exit_code(monkeypatch, command):
    """Runs a sub-command or a script in this process; returns its exit code or message."""
    name, *arguments = command.split()
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    with pytest.raises(SystemExit) as ended, warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # that a module was imported before
        if name == "bgpo":
            bgpo.main()
        else:
            runpy.run_path(str(ROOT / "benchmarks" / name), run_name="__main__")
    return ended.value.code


CASES = [
    # settings of a run
    ("continual.py --episodes 0", "episodes"),
    ("bgpo continual --threads 0", "threads"),
    ("concurrent_tasks.py --device cuda:99", "cuda:99"),
    ("bgpo continual --config new", "--config"),
    ("eight_tasks.py --eval-every 0", "eval_every"),
    ("bgpo continual --episodes 10 --eval-every 50", "eval_every must be at most the 10 episodes"),
    ("bgpo concurrent --task-starts 0 5 5", "--task-starts"),
    ("bgpo continual --eval-episodes 0", "set eval_episodes to at least 1"),
    ("speed/steps.py ppo", "no algorithm 'ppo'"),
    # tasks and their demonstrations
    ("bgpo continual --tasks juggle", "'juggle'"),
    ("bgpo continual --bank file", "file is damaged or not a bank"),
    ("bgpo continual --bank new --train-encoders", "--bank"),
    ("bgpo continual --add-task lift_green", "--add-task: name a run with --resume and --out"),
    ("bgpo concurrent --add-task lift_green", "is for `bgpo continual`"),
    # where results go
    ("continual.py --out file/run", "cannot make the folder file/run"),
    ("bgpo continual --preset quick --out run --resume", "algorithm holds no settings"),
    ("bgpo continual --out damaged --resume", "config.json, line 1 cannot be read"),
    # runs that are read
    ("bgpo report", "name a run"),
    ("bgpo report run empty", "--out: several folders are given"),
    ("studies/aftermath.py", "nobody acts"),
    # grids of runs
    ("bgpo sweep --block 0", "--block"),
    ("bgpo sweep --seeds 1 2 1", "seeds"),
    ("bgpo sweep --settings eight --tasks grasp_glass", "--tasks"),
    ("bgpo sweep --algorithms", "--algorithms"),
    ("bgpo sweep --settings", "--settings"),
    ("bgpo sweep --cpus-per-run 0", "--cpus-per-run"),
    ("bgpo sweep --gpus-per-run -1", "--gpus-per-run"),
    # measurements
    ("studies/aftermath.py --demonstrators --episodes 0", "--episodes"),
    ("bgpo groups --draws 0", "--draws"),
    ("studies/cut_demonstrations.py new --draws 0", "--draws"),
    ("studies/cut_demonstrations.py new --tasks grasp_glass", "--tasks: name at least two"),
    ("bgpo groups --seeds 0 0", "seeds"),
    ("studies/tasks.py --starts 1", "--starts"),
    ("studies/tasks.py --pictures no-such-folder", "no-such-folder"),
    ("speed/throughput.py --parts", "--parts"),
    ("speed/gwr.py --networks 0", "--networks"),
    ("speed/gwr.py --nodes 20 20", "--nodes"),
    ("speed/gwr.py --nodes 1 20", "--nodes"),
    # encoders
    ("bgpo record file", "cannot make the folder file"),
    ("bgpo bank absent new", "there is no dataset at absent"),
    ("bgpo encoders empty", "empty is not a dataset"),
    ("bgpo encoders empty --settings file", "file must hold settings"),
    ("bgpo continual --encoder-settings file", "add --train-encoders"),
    # flags, in tyro's box
    ("bgpo continual --algorithm.betta 0.2", "--algorithm.betta"),
    ("bgpo continual --algorithm.beta 0.2 --presett quick", "--presett"),
    ("bgpo continual --algorithm.beta -1", "beta must be at least 0"),
    ("bgpo continual --episodes 1.5", "--episodes"),
    ("bgpo watch", "Run directory"),
    ("bgpo encoders empty --config.vae.batch-size 0", "batch_size must be at least"),
]


@pytest.mark.parametrize(("command", "cause"), CASES, ids=[case[0] for case in CASES])
def test_a_wrong_command_line_ends_in_a_line_or_a_box_and_writes_nothing(
    folder, monkeypatch, capsys, command, cause
):
    before = contents(folder)
    ended = exit_code(monkeypatch, command)
    out, message = capsys.readouterr()
    if ended == 2:
        message = " ".join(message.replace("│", " ").split())
        assert "Traceback" not in message
    else:
        assert not message
        message = ended
        assert message.startswith("error: ") and "\n" not in message
    assert cause in message
    assert not out
    assert contents(folder) == before


def test_without_opengl_a_command_that_renders_writes_nothing(folder, run_of, monkeypatch, capsys):
    run_of("bgpo")
    before = contents(folder)
    monkeypatch.setattr(opengl, "refusal", "MUJOCO_GL is 'vulkan': do not set it")
    for command in (
        "bgpo continual --train-encoders --out new",
        "bgpo sweep --preset quick --out new",
        "studies/tasks.py --pictures empty",
        "bgpo record new",
        "bgpo watch runs/bgpo",
        *(f"studies/{name}.py runs/bgpo" for name in ("looking", "aftermath", "one_shot")),
    ):
        assert exit_code(monkeypatch, command) == "error: MUJOCO_GL is 'vulkan': do not set it"
        assert capsys.readouterr() == ("", "")
        assert contents(folder) == before


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("training", [True, False])
def test_an_interrupted_run_exits_with_the_status_for_another_try(capsys, number, training):
    saved = []

    def interrupted(arguments: Arguments):
        # Training takes its step to the end; stages around it, such as final tests, stop at once.
        with interrupts_wait() if training else contextlib.nullcontext():
            signal.raise_signal(number)
            saved.append(1)

    with pytest.raises(SystemExit) as ended:
        command_line(interrupted, [])
    assert ended.value.code == os.EX_TEMPFAIL
    assert "--resume" in capsys.readouterr().err
    assert saved == [1] * training
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_a_signal_waits_until_a_commands_libraries_are_loaded(monkeypatch, capsys):
    loaded = []

    def load(name):
        signal.raise_signal(signal.SIGTERM)
        loaded.append(name)  # not reached by what would interrupt it
        return SimpleNamespace(continual=loaded.append)

    monkeypatch.setattr(bgpo.importlib, "import_module", load)
    monkeypatch.setattr(sys, "argv", ["bgpo", "continual"])
    with pytest.raises(SystemExit) as ended:
        bgpo.main()
    assert ended.value.code == os.EX_TEMPFAIL
    assert loaded == ["bgpo_trl.experiments.run"]
    assert "--resume" in capsys.readouterr().err


def test_warnings_of_the_package_are_one_line_and_those_of_others_as_usual():
    told = []

    def doubtful(arguments: Arguments):
        for place in (bgpo.__file__, torch.__file__):
            told.append(warnings.formatwarning("look", UserWarning, place, 1, line="code"))

    usual = warnings.formatwarning
    command_line(doubtful, [])
    assert told == ["warning: look\n", usual("look", UserWarning, torch.__file__, 1, line="code")]
    assert warnings.formatwarning is usual


def test_other_commands_that_are_interrupted_say_whether_they_continue():
    def record(arguments: RecordArguments):
        raise KeyboardInterrupt

    def probes(arguments: ProbesArguments):
        raise KeyboardInterrupt

    for command, message in (
        (record, "interrupted: the same command continues"),
        (probes, "interrupted"),
    ):
        with pytest.raises(SystemExit) as ended:
            command_line(command, ["data"])
        assert ended.value.code == message


def test_an_error_of_own_code_keeps_its_traceback_unless_it_misuses_the_package():
    def broken(arguments: Arguments):
        raise ValueError("mine is broken")

    def of_a_library(arguments: Arguments):
        torch.zeros(2) @ torch.zeros(3)

    def misuse(arguments: Arguments):
        BGPOConfig(beta=-1.0)

    for command, message in ((broken, "mine is broken"), (of_a_library, "size")):
        with pytest.raises((ValueError, RuntimeError), match=message):
            command_line(command, [])
    with pytest.raises(SystemExit, match=r"^error: beta must be at least 0"):
        command_line(misuse, [])


def test_a_reader_that_has_read_enough_is_no_error():
    line = f"{sys.executable} -m bgpo_trl continual --help | head -1"
    run = subprocess.run(line, shell=True, capture_output=True, text=True, check=True)
    assert (run.stdout, run.stderr) == ("usage: bgpo continual [-h] [OPTIONS]\n", "")
