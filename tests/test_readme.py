"""What the README shows works as it stands."""

import re
from pathlib import Path

import pytest

README = Path(__file__).parents[1] / "README.md"
BLOCKS = re.findall(r"^```python\n(.*?)^```", README.read_text(), re.DOTALL | re.MULTILINE)


def test_there_is_something_to_run():
    assert BLOCKS


@pytest.mark.parametrize("number", range(len(BLOCKS)))
def test_each_block_runs(number):
    exec(compile(BLOCKS[number], f"README.md, python block {number + 1}", "exec"), {})


def test_the_paths_it_names_exist():
    table = re.findall(r"^\| `([\w/.]+)`", README.read_text(), re.MULTILINE)
    assert table
    assert [path for path in table if not (README.parent / path).exists()] == []
