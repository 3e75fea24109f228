"""Tests of the mistakes that scripts/mutations.py makes in the package."""

import ast
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = runpy.run_path(str(Path(__file__).parents[1] / "scripts" / "mutations.py"))


def test_each_mistake_alters_one_place_and_leaves_annotations_and_messages_alone(tmp_path):
    path = tmp_path / "code.py"
    path.write_text(
        "def f(x: int = 2) -> int:\n"
        '    if x < 1 and not ok(x, base=3):  # "über"\n'
        '        raise ValueError(f"{x + 1}")\n'
        "    self.x = x\n"
        "    return -x\n"
    )
    source = path.read_text()
    found = SCRIPT["mutations"](path)
    altered = [mutation.applied(source).splitlines() for mutation in found]
    changed = [[*set(lines) - {*source.splitlines()}] for lines in altered]
    assert sorted(line.strip() for (line,) in changed) == sorted(
        [
            "def f(x: int = 3) -> int:",
            'if x <= 1 and not ok(x, base=3):  # "über"',
            'if x < 2 and not ok(x, base=3):  # "über"',
            'if (x < 1 or not ok(x, base=3)):  # "über"',
            'if not (x < 1 and (not ok(x, base=3))):  # "über"',
            'if x < 1 and (ok(x, base=3)):  # "über"',
            'if x < 1 and not ok(x):  # "über"',
            'if x < 1 and not ok(x, base=4):  # "über"',
            "pass",
            "return None",
            "return (x)",
        ]
    )


@pytest.mark.parametrize(
    ("names", "expected"),
    [(["good"], []), (["good", "bad", "worse"], ["bad"]), (["good", "unknown"], None)],
)
def test_the_first_failure_of_some_tests_is_found(tmp_path, names, expected):
    """Tests that cannot be run are all named, so that nothing passes for caught by them."""
    script, code = Path(SCRIPT["__file__"]), "import runpy, sys\n"
    (tmp_path / "test_it.py").write_text(
        "def test_good(): pass\ndef test_bad(): assert False\ndef test_worse(): assert False\n"
    )
    code += f"script = runpy.run_path({str(script)!r})\nprint(script['failing'](sys.argv[1:]))"
    tests = [f"test_it.py::test_{name}" for name in names]
    command = [sys.executable, "-c", code, *tests]
    told = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    found = tests if expected is None else [f"test_it.py::test_{name}" for name in expected]
    assert ast.literal_eval(told) == found


def test_all_mistakes_in_the_package_can_be_read_and_its_folders_have_their_share():
    drawn = SCRIPT["sample"](50, 0)
    assert drawn == SCRIPT["sample"](50, 0)
    assert 45 <= len(drawn) <= 55
    for mutation in drawn:
        source = mutation.path.read_text()
        assert ast.dump(ast.parse(mutation.applied(source))) != ast.dump(ast.parse(source))
    package = Path("bgpo_trl")
    folders = {path.parent for path in package.rglob("*.py") if len(path.read_text()) > 200}
    assert {mutation.path.parent for mutation in drawn} == folders
