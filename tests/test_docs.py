"""Code and commands in README, CONTRIBUTING and docs/ work as they stand."""

import functools
import importlib.util
import inspect
import re
import runpy
import shlex
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch
import tyro

from bgpo_trl.algorithms import ALGORITHMS
from bgpo_trl.algorithms.bgpo import BGPO
from bgpo_trl.experiments.arguments import Arguments
from bgpo_trl.experiments.settings import run_config
from bgpo_trl.scenes.nico import NicoEnv
from bgpo_trl.transforms import DemonstrationSource

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "suites/nico/README.md")]
PAGES += sorted((ROOT / "docs").glob("*.md"))


def blocks(page, language):
    """Returns the fenced blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)


def without_blocks(page):
    """Returns the running text of a page."""
    return re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)


def commands(page):
    """Returns the commands shown in blocks and in running text, without comments, in one line."""
    text = page.read_text()
    indented = re.findall(r"^    ((?:python|bgpo|make) (?:.*\\\n)*.*)$", text, re.MULTILINE)
    fenced = "\n".join(blocks(page, "bash")).replace("\\\n", " ").splitlines()
    inline = re.findall(r"`((?:python|bgpo|make) [^`]+)`", without_blocks(page))
    shown = [*(block.replace("\\\n", " ") for block in indented), *fenced, *inline]
    return [shlex.join(shlex.split(line, comments=True)) for line in shown]


COMMANDS = sorted({command for page in PAGES for command in commands(page) if command})
OF_PYTHON = [command for command in COMMANDS if command.startswith(("python ", "bgpo "))]


class Parsed(BaseException):
    """Raised in place of doing what a command asks for."""


@pytest.fixture
def parse_only(monkeypatch):
    """Commands end as soon as their arguments are understood."""
    parse = tyro.cli

    def cli(f, *args, **kwargs):
        if inspect.isfunction(f):  # which tyro would call
            f = functools.wraps(f)(lambda *_, **__: None)
        parsed = parse(f, *args, **kwargs)
        if kwargs.get("return_unknown_args") and parsed[1]:
            return parsed  # the rest is for another parser
        raise Parsed

    monkeypatch.setattr(tyro, "cli", cli)


def script_of(command):
    """Returns what a `python` or `bgpo` command runs, file or module, and its arguments."""
    program, *words = shlex.split(command)
    if program == "bgpo":
        return "bgpo_trl", words
    if words[0] == "-m":
        return words[1], words[2:]
    return words[0], words[1:]


def run(script, arguments, monkeypatch):
    """Runs a script as `python script arguments` would."""
    monkeypatch.setattr(sys, "argv", [script, *arguments])
    if script.endswith(".py"):
        runpy.run_path(str(ROOT / script), run_name="__main__")
    else:
        runpy.run_module(script, run_name="__main__", alter_sys=True)


@pytest.mark.parametrize(
    "page", [page for page in PAGES if blocks(page, "python")], ids=lambda page: page.name
)
def test_the_python_of_a_page_runs_from_top_to_bottom(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    namespace = {}
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        for number, block in enumerate(blocks(page, "python"), 1):
            exec(compile(block, f"{page.name}, python block {number}", "exec"), namespace)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_all_that_a_page_shows_is_tested_and_what_it_names_exists(page, tmp_path):
    fences = re.findall(r"^```(.*)$", page.read_text(), re.MULTILINE)
    # Scripts (sh) are run by tests of their own.
    assert {*fences[::2]} <= {"python", "bash", "sh", "yaml", "text"}
    assert {*fences[1::2]} <= {""}
    for block in blocks(page, "yaml"):
        (tmp_path / "settings.yaml").write_text(block)
        assert run_config(Arguments(config=tmp_path / "settings.yaml")) != run_config(Arguments())
    text = without_blocks(page)
    named = re.findall(
        r"`((?:suites|bgpo_trl|benchmarks|examples|tests|docs|scripts)/[\w/.-]*)`", text
    )
    linked = re.findall(r"\]\(([\w/.-]+)\)", text)
    missing = [name for name in named if not (ROOT / name).exists()]
    missing += [name for name in linked if not (page.parent / name).exists()]
    assert missing == []


def test_commands_are_found():
    assert {"make run", "make test"} <= {*COMMANDS}
    assert len(OF_PYTHON) > 5


@pytest.mark.parametrize("command", OF_PYTHON)
def test_a_command_is_understood(command, monkeypatch, parse_only):
    script, arguments = script_of(command)
    if script.endswith(".py"):
        assert (ROOT / script).is_file()
    else:
        assert importlib.util.find_spec(script)
    if script.startswith("examples/"):
        assert not arguments  # and what they do is tested in test_examples.py
    elif arguments[script == "bgpo_trl" :]:  # without, it may be a name rather than a command
        # A module that the page shows.
        module = ModuleType("my_algorithm")
        module.__file__ = str(ROOT / "my_algorithm.py")
        monkeypatch.setitem(sys.modules, "my_algorithm", module)
        monkeypatch.setitem(ALGORITHMS, "mine", ALGORITHMS["bgpo"])
        with pytest.raises(Parsed):
            run(script, arguments, monkeypatch)


@pytest.mark.parametrize("command", sorted({*COMMANDS} - {*OF_PYTHON}))
def test_a_verb_or_tool_is_there(command):
    tool, *words = shlex.split(command)
    assert tool == "make"
    verbs = re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    asked = [word for word in words if "=" not in word]
    assert [verb for verb in asked if verb not in verbs] == []


def test_readme_composes_the_environment_in_which_bgpo_is_trained():
    block = next(block for block in blocks(ROOT / "README.md", "python") if "Compose(" in block)
    shown = {}
    exec(block, shown)
    bank, encoders = shown["bank"].seen(), shown["encoders"]
    algorithm = BGPO(shown["config"], seeds=[0, 1], bank=bank, encoders=encoders)
    source = DemonstrationSource(bank, shown["schedule"], batch_size=[2])
    trained = algorithm.make_env(NicoEnv(batch_size=[2]), source)
    kinds = [[type(part) for part in env.transform] for env in (shown["env"], trained)]
    assert kinds[0] == kinds[1]
