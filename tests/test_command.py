"""The command ``bgpo``: its list of sub-commands, and how each is called."""

import subprocess
import sys
from pathlib import Path

import pytest

from bgpo_trl import __main__ as command
from bgpo_trl.experiments.watch import WatchArguments

ROOT = Path(__file__).parents[1]
NAMES = [name for commands in command.COMMANDS.values() for name in commands]
LOADED = """
import resource, sys
from bgpo_trl.__main__ import main
sys.argv = ["bgpo", *sys.argv[1:]]
try:
    main()
except SystemExit as ended:
    assert not ended.code
assert not {"torch", "torchrl", "mujoco"} & sys.modules.keys()
used = resource.getrusage(resource.RUSAGE_SELF)
assert used.ru_utime + used.ru_stime < 3
"""


def call(monkeypatch, *options):
    monkeypatch.setattr(sys, "argv", ["bgpo", *options])
    command.main()


def test_help_lists_every_command(monkeypatch, capsys):
    call(monkeypatch)
    printed = capsys.readouterr().out.splitlines()
    assert len(NAMES) <= 12
    listed = [line.split(maxsplit=1) for line in printed if line.startswith("  ")]
    assert [name for name, _ in listed] == NAMES
    assert {*command.COMMANDS} <= {*printed}
    assert all(line.endswith(".") for _, line in listed)


def run(code, *arguments):
    program = [sys.executable, "-c", code, *arguments]
    process = subprocess.run(program, capture_output=True, text=True, cwd=ROOT)
    assert process.returncode == 0, process.stderr


def test_help_imports_neither_torch_nor_mujoco():
    run(LOADED, "continual", "--help")


def test_results_are_read_without_a_display():
    """No display, which dm_control opens, to read results."""
    run("import sys, bgpo_trl.experiments.report\nassert 'dm_control' not in sys.modules")


def test_an_unknown_command_is_refused(monkeypatch, capsys):
    with pytest.raises(SystemExit) as ended:
        call(monkeypatch, "continul")
    assert ended.value.code == 2
    assert "continul" in capsys.readouterr().err


@pytest.mark.parametrize("name", NAMES)
def test_every_command_has_a_function_and_a_help_page(monkeypatch, capsys, name):
    with pytest.raises(SystemExit) as ended:
        call(monkeypatch, name, "--help")
    assert not ended.value.code
    assert f"usage: bgpo {name} " in capsys.readouterr().out


@pytest.mark.parametrize(("name", "tasks"), [("continual", (0, 4, 8)), ("concurrent", (0, 0, 0))])
def test_experiments_keep_the_command_that_repeats_them(tmp_path, monkeypatch, name, tasks):
    monkeypatch.chdir(tmp_path)
    ran = []

    def run_experiment(arguments, experiment, config):
        ran.append((list(sys.argv), experiment, config.task_starts))

    monkeypatch.setattr("bgpo_trl.experiments.run.run_experiment", run_experiment)
    call(monkeypatch, name, "--preset", "smoke")
    assert ran == [(["-m", "bgpo_trl", name, "--preset", "smoke"], name, tasks)]


def test_a_command_imports_the_named_module_first_and_its_result_is_printed(monkeypatch, capsys):
    asked = []

    def watch(arguments: WatchArguments) -> str:
        asked.append(arguments)
        return "pictures"

    monkeypatch.setattr("bgpo_trl.experiments.watch.watch", watch)
    monkeypatch.setattr("bgpo_trl.experiments.command_line.import_plugin", asked.append)
    call(monkeypatch, "watch", "runs/own", "--import", "my_tasks")
    assert asked == ["my_tasks", WatchArguments(run=Path("runs/own"), module="my_tasks")]
    assert capsys.readouterr().out == "pictures\n"
