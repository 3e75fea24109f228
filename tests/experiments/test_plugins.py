"""Import of the user's tasks by name."""

import re
import sys

import pytest

from bgpo_trl.experiments.command_line import import_plugin
from suites import nico

OWN = """
from suites import nico

class Juggle(nico.NicoTask):
    pass

nico.add_task("juggle", Juggle)
"""


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """The current folder, with a module of tasks in it that is forgotten after the test."""
    (tmp_path / "juggling.py").write_text(OWN)
    (tmp_path / "astray.py").write_text("import no_such_library\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path])
    yield tmp_path
    sys.modules.pop("juggling", None)


def test_a_module_of_the_current_folder_adds_its_tasks(folder):
    import_plugin(None)
    assert "juggle" not in nico.TASKS
    import_plugin("juggling")
    assert nico.TASKS["juggle"].__module__ == "juggling"
    assert sys.modules["juggling"].__file__ == str(folder / "juggling.py")


@pytest.mark.parametrize(
    "name", ["juggle", "juggling.py", "juggling.tasks", "no.such", "./juggling", ".juggling", ""]
)
def test_a_missing_module_is_refused(folder, name):
    message = rf"^--import {re.escape(name)}: there is no such module in {folder}"
    with pytest.raises(ValueError, match=message):
        import_plugin(name)


def test_an_import_error_within_the_module_is_raised_unchanged():
    with pytest.raises(ModuleNotFoundError, match="no_such_library"):
        import_plugin("astray")


def test_a_module_hidden_by_another_one_is_refused(folder):
    (folder / "json.py").write_text(OWN)
    with pytest.raises(ValueError, match=r"^--import json: .*json.* has the same name: rename "):
        import_plugin("json")
    assert "juggle" not in nico.TASKS
