"""The command line of the installed package."""

import importlib.metadata
import subprocess
import sys

import pytest

import bgpo_trl
from bgpo_trl import __main__ as command


def test_the_version_is_that_of_the_package():
    assert bgpo_trl.__version__ == importlib.metadata.version("bgpo_trl")


@pytest.mark.parametrize("options", [[], ["--help"]])
def test_without_a_command_it_lists_them(options):
    with pytest.raises(SystemExit, match="usage: python -m bgpo_trl COMMAND") as ended:
        command.main(options)
    for name in ("continual", "concurrent", "ablation", "doctor"):
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


def test_the_module_is_a_command():
    told = subprocess.run([sys.executable, "-m", "bgpo_trl"], capture_output=True, text=True)
    assert told.returncode == 1
    assert told.stderr.startswith("usage: python -m bgpo_trl COMMAND")
