"""Mistakes at the command line: one line, exit status 1, and nothing half-written.

Flags that there are not, and values that are no numbers or no choices, are tyro's own to refuse: a
box of several lines with exit status 2, which must name the flag and, where there are some, the
choices. Cases are as in `tests/test_bad_input.py`.
"""

import os
import runpy
import subprocess
import sys
import warnings
from pathlib import Path

import mujoco
import pytest

from bgpo_trl.runs.logger import EVAL_COLUMNS
from suites import opengl
from tests.folders import contents

ROOT = Path(__file__).parents[2]


@pytest.fixture
def folder(tiny, tmp_path, monkeypatch):
    """A folder to be in, with a file, an empty folder, and runs of some kind."""
    monkeypatch.chdir(tmp_path)
    for name in ("empty", "run", "damaged", "unevaluated"):
        (tmp_path / name).mkdir()
    (tmp_path / "file").touch()
    (tmp_path / "run" / "config.json").write_text('{"episodes": 50, "name": "bgpo"}')
    (tmp_path / "damaged" / "config.json").write_text('{"episodes": ')
    header = ",".join(EVAL_COLUMNS) + "\n"
    (tmp_path / "damaged" / "eval.csv").write_text(header + "bgpo,0,ten,5,grasp_glass,1,1,5\n")
    (tmp_path / "unevaluated" / "eval.csv").write_text(header)
    return tmp_path


def ended_with(monkeypatch, command):
    """Runs a script or module in this process; returns what it hands to the shell."""
    name, *arguments = command.split()
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    with pytest.raises(SystemExit) as ended, warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # that a module was imported before
        if name.endswith(".py"):
            runpy.run_path(str(ROOT / "benchmarks" / name), run_name="__main__")
        else:
            runpy.run_module(name, run_name="__main__", alter_sys=True)
    return ended.value.code


CASES = [
    # settings of a run
    ("continual.py --episodes 0", "episodes", "must be at least 1, got 0"),
    ("continual.py --seeds 1 1", "(1, 1)", "all different"),
    ("continual.py --seeds -1", "(-1,)", "none negative"),
    ("continual.py --seeds", "seeds must be one or more", "()"),
    ("continual.py --threads 0", "threads", "must be at least 1, got 0"),
    ("continual.py --device cuda:99", "no device 'cuda:99'", "use auto or cpu"),
    ("concurrent_tasks.py --device gpu", "no device 'gpu'", "use auto or cpu"),
    ("ablation.py --algorithm maml", "--algorithm", "the variants are BGPO's"),
    ("continual.py --episodes 10 --eval-every 50", "eval_every", "at most the 10 episodes"),
    ("continual.py --algorithm bgpo-paper --rl sac", "--rl: bgpo-paper uses DDPG", "leave --rl"),
    ("continual.py --algorithm maml --rl td3", "MAML is defined over DDPG", "not 'td3'"),
    ("continual.py --algorithm ppo", "--algorithm: there is no 'ppo'", "name one of bgpo, "),
    ("continual.py --rl ppo", "--rl: there is no 'ppo'; name one of ddpg", "with --import MODULE"),
    ("eight_tasks.py --eval-every 0", "eval_every", "must be at least 1, got 0"),
    ("speed/steps.py ppo", "no algorithm 'ppo'", "choose one of bgpo"),
    ("ladder.py --rungs", "--rungs is empty", "name some of a, b, c, d"),
    ("ladder.py --rungs a b a", "--rungs: name each once", "a b a"),
    ("ladder.py --episodes 0", "episodes", "must be at least 1, got 0"),
    ("ladder.py --threads 0", "threads", "must be at least 1, got 0"),
    # tasks and their demonstrations
    ("continual.py --tasks juggle", "there is no task 'juggle'", "with --import MODULE"),
    ("continual.py --tasks", "--tasks: it is empty", "name some of grasp_glass"),
    ("continual.py --import juggling", "--import juggling: there is no such", "give the name"),
    ("continual.py --bank file", "file is damaged or not a bank", "encoders.make_bank`"),
    ("continual.py --bank new", "there is no demonstration bank at new", "encoders.make_bank`"),
    ("continual.py --bank new --train-encoders", "--bank is of the pretrained", "leave it or"),
    ("watch.py run --import juggling", "--import juggling: there is no such", "give the name"),
    ("one_shot.py run --import juggling", "--import juggling: there is no such", "give the name"),
    ("looking.py run --import juggling", "--import juggling: there is no such", "give the name"),
    # where it goes
    ("continual.py --out file", "cannot make the folder file", "choose another"),
    ("continual.py --out file/run", "cannot make the folder file/run", "choose another"),
    ("continual.py --out unevaluated", "unevaluated holds a run", "--resume cont"),
    ("continual.py --out run", "run holds a run", "--resume continues it, --out names another"),
    ("continual.py --out run --resume", "other settings (episodes is 50 there", "the same sett"),
    ("continual.py --out damaged --resume", "config.json is damaged", "put it back as the run"),
    ("ladder.py --rungs a --out file", "cannot make the folder file/a", "choose another"),
    # runs that are read
    ("compare.py nowhere empty", "there is no run at nowhere", "name another"),
    ("compare.py empty nowhere", "empty/config.json is missing", "let the run in empty finish"),
    ("compare.py damaged damaged", "config.json is damaged", "put it back as the run left it"),
    ("compare.py run run --every 0", "--every", "at least 1 episode, got 0"),
    ("report.py", "name a run", "or a folder of runs"),
    ("report.py file", "file is not a directory", "name a run, or a folder of runs"),
    ("report.py run", "run holds no test episode", "let the run evaluate first"),
    ("report.py empty", "empty holds no run", "name a run, or a folder of runs"),
    ("report.py damaged", "config.json is damaged", "put it back as the run left it"),
    ("looking.py empty", "empty holds no run", "there is no config.json"),
    ("aftermath.py empty", "empty holds no run", "there is no config.json"),
    # measurements
    ("aftermath.py", "nobody acts", "name a run directory, or give --demonstrators"),
    ("aftermath.py --demonstrators --episodes 0", "--episodes", "at least 1, got 0"),
    ("speed/throughput.py --parts", "--parts is empty", "name some of frames"),
    ("speed/throughput.py --rounds 0", "--rounds", "at least 1, got 0"),
    ("speed/throughput.py --threads 0", "--threads", "at least 1, got 0"),
    ("speed/gwr.py --nodes", "--nodes", "one or more, of at least 2"),
    ("speed/gwr.py --networks 0", "--networks", "at least 1, got 0"),
    ("groups.py --seeds 0 0", "seeds must be one or more", "all different"),
    ("groups.py --draws 0", "--draws", "at least 1, got 0"),
    ("unknown_task.py --seeds 0 0", "seeds must be one or more", "all different"),
    ("unknown_task.py --tasks grasp_glass", "--tasks", "name at least two"),
    ("nico_tasks.py --starts 1", "--starts", "at least 2, got 1"),
    ("nico_tasks.py --pictures no-such-folder", "no-such-folder", "make it first"),
    # stage 1
    ("bgpo_trl.data.recording file", "cannot make the folder file", "choose another"),
    ("bgpo_trl.data.recording new --per-task 0", "held_out_per_task", "less than per_task, 0"),
    ("bgpo_trl.data.recording new --seed -1", "seed", "must be at least 0, got -1"),
    ("bgpo_trl.data.recording new --tasks juggle", "no NICO task 'juggle'", "choose one of"),
    ("bgpo_trl.data.recording new --import juggling", "--import juggling", "give the name"),
    ("bgpo_trl.encoders.make_bank absent new", "there is no dataset at absent", "record it again"),
    ("bgpo_trl.encoders.make_bank empty new", "empty is not a dataset", "record it again with"),
    ("bgpo_trl.encoders.train empty", "empty is not a dataset", "record it again with"),
    ("bgpo_trl.encoders.train empty --device gpu", "empty is not a dataset", "record it again"),
    ("bgpo_trl.encoders.probes empty --weights file", "file is damaged", "--train-encoders"),
    ("bgpo_trl.encoders.probes file", "file is not a dataset", "record it again with"),
    ("suites.nico.explore --task juggle --out a.gif", "'juggle'", "choose one of grasp_glass"),
    ("suites.nico.explore --out a.jpeg", "cannot write a.jpeg", "ends in .png or .gif"),
    ("suites.nico.explore --out file/a.png", "there is no folder file", "make it first"),
]


@pytest.mark.parametrize(("command", "cause", "remedy"), CASES, ids=[case[0] for case in CASES])
def test_a_command_that_cannot_be_is_answered_in_one_line(
    folder, monkeypatch, capsys, command, cause, remedy
):
    before = contents(folder)
    told = ended_with(monkeypatch, command)
    assert isinstance(told, str), capsys.readouterr().err
    assert told.startswith("error: ")
    assert "\n" not in told
    assert cause in told
    assert remedy in told
    assert capsys.readouterr() == ("", "")
    assert contents(folder) == before


@pytest.mark.parametrize(
    ("command", "named"),
    [
        ("continual.py --presett quick", "--presett"),
        ("ladder.py --presett quick", "--presett"),
        ("continual.py --preset huge", "desk"),
        ("continual.py --episodes 1.5", "--episodes"),
        ("continual.py --seeds a", "--seeds"),
        ("ablation.py --variant any", "gwr+r_int"),
        ("ladder.py --rungs e", "--rungs"),
        ("ladder.py ddpg --gamma 1.5", "gamma must be between 0 and 1, got 1.5"),
        ("ladder.py sac --hidden-sizes 64 0", "hidden_sizes must be one or more"),
        ("compare.py run", "Directory of the second run"),
        ("bgpo_trl.encoders.train empty --config.vae.batch-size 0", "batch_size must be at least"),
        ("bgpo_trl.data.recording", "PATH"),
        ("suites.nico.explore --random --demonstrate", "--demonstrate"),
    ],
)
def test_a_flag_that_cannot_be_is_named(folder, monkeypatch, capsys, command, named):
    before = contents(folder)
    assert ended_with(monkeypatch, command) == 2
    out, told = capsys.readouterr()
    assert named in " ".join(told.replace("│", " ").split())
    assert "Traceback" not in told
    assert not out
    assert contents(folder) == before


@pytest.mark.parametrize(
    ("command", "name"),
    [
        ("continual.py --rl sac", "continual-bgpo-sac-quick"),
        ("concurrent_tasks.py --rl sac", "concurrent-bgpo-sac-quick"),
        ("ablation.py --rl sac --variant gwr", "ablation-gwr-sac-quick"),
    ],
)
def test_a_run_with_another_rl_algorithm_has_a_name_of_its_own(folder, monkeypatch, command, name):
    (folder / "runs" / name).mkdir(parents=True)
    (folder / "runs" / name / "config.json").touch()
    told = ended_with(monkeypatch, command)
    assert told.startswith(f"error: runs/{name} holds a run: --resume")


def test_a_folder_that_may_not_be_written_is_told(folder, monkeypatch):
    def refuse(path, *args, **kwargs):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "mkdir", refuse)
    before = contents(folder)
    told = ended_with(monkeypatch, "continual.py --out elsewhere/run")
    assert told == "error: cannot make the folder elsewhere/run (Permission denied): choose another"
    assert contents(folder) == before


def test_without_opengl_no_recording_is_begun(folder, monkeypatch):
    monkeypatch.setattr(opengl, "refusal", "MUJOCO_GL is 'vulkan': do not set it")
    before = contents(folder)
    told = ended_with(monkeypatch, "bgpo_trl.data.recording new --per-task 2 --held-out-per-task 1")
    assert told == "error: MUJOCO_GL is 'vulkan': do not set it"
    assert contents(folder) == before


def test_without_a_context_no_run_is_begun(folder, monkeypatch):
    def refuse(*args, **kwargs):
        raise ValueError("no display\nof any kind")

    monkeypatch.setattr(mujoco, "Renderer", refuse)
    before = contents(folder)
    told = ended_with(monkeypatch, "concurrent_tasks.py --out new")
    assert told.startswith("error: no OpenGL context from the ")
    assert "(no display): set MUJOCO_GL" in told and "\n" not in told
    assert contents(folder) == before


def test_without_a_backend_that_there_is_no_run_is_begun(tmp_path):
    """In a process of its own, since MuJoCo reads the variable when it is imported."""
    process = subprocess.run(
        [sys.executable, str(ROOT / "benchmarks" / "concurrent_tasks.py"), "--out", "run"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT), "MUJOCO_GL": "vulkan"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert process.returncode == 1
    assert process.stderr.startswith(
        "error: MUJOCO_GL is 'vulkan', which is not an OpenGL backend: set it to egl"
    )
    assert process.stderr.count("\n") == 1
    assert not process.stdout
    assert not list(tmp_path.iterdir())
