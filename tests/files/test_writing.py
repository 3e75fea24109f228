"""Files that are replaced as a whole."""

import json
from pathlib import Path

import pytest

from bgpo_trl.files.writing import write_json, write_whole


def test_a_file_is_written_and_replaced(tmp_path):
    for content, found in (("a\n", b"a\n"), (b"\x00b", b"\x00b")):
        write_whole(tmp_path / "file", content)
        assert (tmp_path / "file").read_bytes() == found
    write_json(tmp_path / "file", {"a": [1, None]})
    assert json.loads((tmp_path / "file").read_text()) == {"a": [1, None]}
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_failed_write_keeps_the_old_file(tmp_path, monkeypatch):
    def half(path, content):
        with path.open("wb") as file:
            file.write(content[:1])
        raise OSError(28, "No space left on device")

    write_whole(tmp_path / "file", "old")
    monkeypatch.setattr(Path, "write_bytes", half)
    with pytest.raises(OSError, match="No space left"):
        write_whole(tmp_path / "file", "new")
    assert (tmp_path / "file").read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
