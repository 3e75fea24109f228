"""The command line of the installed package."""

import importlib.abc
import importlib.metadata
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

import bgpo_trl
from bgpo_trl import __main__ as command
from bgpo_trl.configs import PRESETS
from bgpo_trl.experiments.watch import WatchArguments


def test_the_version_is_that_of_the_package():
    assert bgpo_trl.__version__ == importlib.metadata.version("bgpo_trl")


@pytest.mark.parametrize("options", [[], ["--help"]])
def test_without_a_command_it_lists_them(options):
    with pytest.raises(SystemExit, match="usage: python -m bgpo_trl COMMAND") as ended:
        command.main(options)
    for name in ("continual", "concurrent", "ablation", "watch", "doctor"):
        assert f"  {name} " in str(ended.value)


def test_an_unknown_command_is_refused():
    with pytest.raises(SystemExit, match=r"^error: no command 'continul'\nusage: "):
        command.main(["continul"])


def test_errors_are_one_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match=r"^error: --algorithm: the variants"):
        command.main(["ablation", "--algorithm", "maml"])


@pytest.mark.parametrize(("name", "tasks"), [("continual", (0, 4, 8)), ("concurrent", (0, 0, 0))])
def test_commands_run_their_experiment_in_any_folder(tmp_path, monkeypatch, name, tasks):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["ignored"])
    ran = []

    def run_experiment(arguments, experiment, config):
        ran.append((sys.argv, experiment, config.task_starts))
        return "done"

    monkeypatch.setattr("bgpo_trl.experiments.paper.run_experiment", run_experiment)
    command.main([name, "--preset", "smoke"])
    assert ran == [(["-m", "bgpo_trl", name, "--preset", "smoke"], name, tasks)]


def test_a_run_can_be_watched(tmp_path, monkeypatch, capsys):
    asked = []

    def watch(arguments):
        asked.append(arguments)
        return "pictures"

    monkeypatch.setattr("bgpo_trl.experiments.watch.watch", watch)
    command.main(["watch", "runs/own", "--import", "my_tasks"])
    assert asked == [WatchArguments(Path("runs/own"), module="my_tasks")]
    assert capsys.readouterr().out == "pictures\n"


def test_help_tells_how_large_each_preset_is(capsys):
    with pytest.raises(SystemExit):
        command.main(["continual", "--help"])
    told = " ".join(capsys.readouterr().out.replace("\u2502", " ").split())
    for name, config in PRESETS.items():
        size = rf"{name} \({config.episodes:,} episodes of {len(config.seeds)} seeds, [^)]*"
        assert re.search(size + r"(minutes|hours|day)", told), told


def test_ctrl_c_while_it_imports_ends_it_in_one_line(monkeypatch):
    class Interrupt(importlib.abc.MetaPathFinder):
        def find_spec(self, fullname, path=None, target=None):
            if fullname == "bgpo_trl.experiments.paper":
                raise KeyboardInterrupt

    monkeypatch.setattr(sys, "meta_path", [Interrupt(), *sys.meta_path])
    monkeypatch.delitem(sys.modules, "bgpo_trl.experiments.paper", raising=False)
    monkeypatch.delattr("bgpo_trl.experiments.paper", raising=False)
    monkeypatch.delitem(sys.modules, "bgpo_trl.__main__")  # which runpy would warn of
    monkeypatch.setattr(sys, "argv", ["bgpo_trl", "continual"])
    with pytest.raises(SystemExit, match=r"^interrupted$"):
        runpy.run_module("bgpo_trl", run_name="__main__")


def test_the_module_is_a_command():
    told = subprocess.run([sys.executable, "-m", "bgpo_trl"], capture_output=True, text=True)
    assert told.returncode == 1
    assert told.stderr.startswith("usage: python -m bgpo_trl COMMAND")
