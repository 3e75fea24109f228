"""CSV files: rows are written whole, read back exactly and continued."""

import csv
import errno
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from bgpo_trl.files.csv_file import CsvFile
from tests.helpers import largest_file

COLUMNS = ("episode", "task", "return")
HEAD = b"episode,task,return\n"


def test_rows_are_written_at_once_and_continued_after_reopening(tmp_path):
    path = tmp_path / "eval.csv"
    first = CsvFile(path, COLUMNS)
    first.write({"return": 0.1, "episode": 1})
    assert path.read_bytes() == HEAD + b"1,,0.1\n"
    # Reopened without a close, as after a kill.
    second = CsvFile(path, COLUMNS)
    second.write({"episode": 2, "task": 'push "green", slowly', "return": 1})
    with pytest.raises(ValueError, match="has no column loss"):
        second.write({"episode": 3, "loss": 0.5})
    assert path.read_bytes() == HEAD + b'1,,0.1\n2,"push ""green"", slowly",1\n'


@settings(max_examples=50)
@given(value=st.floats(), number=st.integers())
def test_numbers_are_read_back_exactly(value, number, tmp_path_factory):
    path = tmp_path_factory.mktemp("csv") / "eval.csv"
    with CsvFile(path, COLUMNS) as file:
        file.write({"episode": number, "return": value})
    row = next(csv.DictReader(path.open()))
    assert int(row["episode"]) == number
    assert float(row["return"]) == value or (math.isnan(value) and row["return"] == "nan")


def test_values_of_one_element_are_written_as_numbers(tmp_path):
    values = [True, torch.tensor([False]), np.bool_(True), torch.tensor(0.5), np.int64(3), None]
    with CsvFile(tmp_path / "eval.csv", COLUMNS) as file:
        for value in values:
            file.write({"return": value})
    written = (tmp_path / "eval.csv").read_text().splitlines()[1:]
    assert written == [f",,{text}" for text in ("1", "0", "1", "0.5", "3", "")]


@pytest.mark.parametrize(
    "content", ["episode,return\n1,2\n", "no newline", "episode,task,return2\n"]
)
def test_a_file_with_other_columns_is_refused_unchanged(content, tmp_path, refused):
    path = tmp_path / "eval.csv"
    path.write_text(content)
    refused(lambda: CsvFile(path, COLUMNS), "begins with", "choose another run directory")


def test_a_partial_last_row_is_dropped(tmp_path):
    path, whole = tmp_path / "eval.csv", HEAD + b"1,grasp,0\n2,push,1\n"
    for cut in range(len(whole)):
        path.write_bytes(whole[:cut])
        with CsvFile(path, COLUMNS) as file:
            file.write({"episode": 3})
        rows = b"1,grasp,0\n" if cut >= len(HEAD) + 10 else b""
        assert path.read_bytes() == HEAD + rows + b"3,,\n", cut


def test_truncation_within_a_row_is_refused(tmp_path):
    path = tmp_path / "eval.csv"
    with CsvFile(path, COLUMNS) as file:
        file.write({"episode": 1})
        end = file.position()
        for position in (end + 1, end - 1):
            with pytest.raises(ValueError, match=f"no row that ends at byte {position}"):
                file.truncate_to(position)
        assert path.stat().st_size == end
        file.truncate_to(0)
    assert path.read_bytes() == HEAD


@pytest.mark.parametrize("room", range(6))
def test_a_row_that_does_not_fit_on_the_disk_is_not_written_in_part(room, tmp_path):
    path = tmp_path / "eval.csv"
    with CsvFile(path, COLUMNS) as file:
        file.write({"episode": 1})
        before = path.read_bytes()
        with (
            largest_file(len(before) + room),
            pytest.raises(OSError, match=r"cannot write to .*: make room") as error,
        ):
            file.write({"episode": 2000})  # 7 bytes
        assert error.value.errno in (errno.ENOSPC, errno.EFBIG)
        assert path.read_bytes() == before
        file.write({"episode": 2000})
    assert path.read_bytes() == before + b"2000,,\n"
