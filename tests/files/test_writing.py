"""Files that are replaced as a whole."""

import json

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from bgpo_trl.experiments.records import write_rows
from bgpo_trl.figures.frames import save_gif
from bgpo_trl.figures.of_run import write_nodes
from bgpo_trl.figures.page import write_page
from bgpo_trl.figures.style import save_figure
from bgpo_trl.files.checkpoint import load_checkpoint, save_checkpoint
from bgpo_trl.files.csv_file import CsvFile
from bgpo_trl.files.tensor_file import save_tensors
from bgpo_trl.files.writing import write_json, write_whole
from bgpo_trl.runs.cost import write_costs
from tests.files.full_disk import largest_file


def test_a_file_is_written_and_replaced(tmp_path):
    for content, found in (("a\n", b"a\n"), (b"\x00b", b"\x00b")):
        write_whole(tmp_path / "file", content)
        assert (tmp_path / "file").read_bytes() == found
    write_json(tmp_path / "file", {"a": [1, None]})
    assert json.loads((tmp_path / "file").read_text()) == {"a": [1, None]}
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_failed_write_keeps_the_old_file(tmp_path):
    write_whole(tmp_path / "file", "old")
    with largest_file(1), pytest.raises(OSError, match="File too large"):
        write_whole(tmp_path / "file", "new")
    assert (tmp_path / "file").read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


WRITERS = {
    "text": lambda path: write_whole(path, "new"),
    "figure": lambda path: save_figure(Figure(), path),
    "gif": lambda path: save_gif(np.zeros((2, 32, 64, 3), np.uint8), path),
    "page": lambda path: write_page(path, [], {}),
    "tensors": lambda path: save_tensors(path, {"a": torch.zeros(2)}, {}),
    "rows": lambda path: write_rows(path, ["a"], [[1]]),
    "costs": lambda path: write_costs(path, {}),
    "nodes": lambda path: write_nodes(path, torch.zeros(2, 3), torch.zeros(2)),
}


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS.keys())
@pytest.mark.parametrize("name", ["file", "file.tmp"])
def test_a_symbolic_link_is_replaced_and_not_written_through(tmp_path, write, name):
    write(tmp_path / "reference")
    (tmp_path / "private").write_text("private")
    (tmp_path / name).symlink_to(tmp_path / "private")
    write(tmp_path / "file")
    assert (tmp_path / "private").read_text() == "private"
    assert not (tmp_path / "file").is_symlink()
    assert (tmp_path / "file").read_bytes() == (tmp_path / "reference").read_bytes()
    assert not (tmp_path / "file.tmp").is_symlink()


def test_a_checkpoint_is_not_written_through_a_symbolic_link(tmp_path):
    (tmp_path / "private").write_text("private")
    folder = tmp_path / "checkpoint"
    folder.mkdir()
    (folder / "checkpoint.tmp").symlink_to(tmp_path / "private")
    save_checkpoint(folder, {"episode": 1})
    assert (tmp_path / "private").read_text() == "private"
    assert load_checkpoint(folder) == {"episode": 1}


@pytest.mark.parametrize("exists", [True, False])
def test_rows_are_not_appended_through_a_symbolic_link(tmp_path, refused, exists):
    if exists:
        (tmp_path / "private").touch()
    (tmp_path / "eval.csv").symlink_to(tmp_path / "private")
    refused(lambda: CsvFile(tmp_path / "eval.csv", ["a"]), "symbolic links", "choose another")
    assert (tmp_path / "private").exists() == exists
