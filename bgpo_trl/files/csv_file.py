"""CSV files that survive kills, full disks and resumed runs."""

from __future__ import annotations

import csv
import errno
import io
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self


class CsvFile:
    r"""Append-only CSV file with fixed columns that can be truncated to an earlier position.

    An existing file is continued. Rows are written unbuffered and whole: killing the process loses
    no row, a row that does not fit on the disk leaves no trace, and opening the file drops a
    partial row left by a crash. Tensors and NumPy values of one element are written as numbers,
    booleans as 0 and 1, and floats with enough digits to be read back exactly.

    Raises:
        ValueError: If the file exists with other columns.
        OSError: If the file cannot be written.

    Examples:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "eval.csv"
        >>> with CsvFile(path, ["episode", "return"]) as file:
        ...     file.write({"episode": 1, "return": 0.5})
        ...     position = file.position()
        ...     file.write({"episode": 2, "return": 1.0})
        ...     file.truncate_to(position)
        >>> path.read_text()
        'episode,return\n1,0.5\n'
    """

    def __init__(self, path: str | os.PathLike[str], columns: Sequence[str]) -> None:
        self.path, self.columns = Path(path), tuple(columns)
        header = self._line(dict(zip(self.columns, self.columns, strict=True)))
        self._header_size = len(header)
        try:
            self._file = open(self.path, "a+b", buffering=0)  # noqa: SIM115
        except OSError as error:
            raise OSError(
                f"cannot write {self.path} ({error.strerror}): choose another run directory"
            ) from None
        self._file.seek(0)
        content = self._file.read()
        if not header.startswith(content[: len(header)]):
            self._file.close()
            found = content[:300].partition(b"\n")[0].decode(errors="replace").strip()
            raise ValueError(
                f"{self.path} begins with {found!r}, not with the columns "
                f"{','.join(self.columns)} of this run: choose another run directory."
            )
        self._file.truncate(content.rfind(b"\n") + 1)
        if len(content) < len(header):
            self._append(header)

    def write(self, row: Mapping[str, Any]) -> None:
        """Append a row of values by column; columns without a value stay empty.

        Raises:
            ValueError: If the file has no such column.
            OSError: If the row cannot be written; the file then ends with the previous row.
        """
        unknown = [name for name in row if name not in self.columns]
        if unknown:
            raise ValueError(
                f"{self.path.name} has no column {', '.join(unknown)}: name it when the run is "
                f"created, or write only {', '.join(self.columns)}."
            )
        self._append(self._line({name: plain_value(value) for name, value in row.items()}))

    def position(self) -> int:
        """Flush the file to disk and return its size in bytes."""
        os.fsync(self._file.fileno())
        return self._file.seek(0, os.SEEK_END)

    def truncate_to(self, position: int) -> None:
        """Drop all rows after a result of `position`; 0 drops all and keeps the header.

        Raises:
            ValueError: If the file is shorter, or the position is not the end of a row.
        """
        position = max(position, self._header_size)
        self._file.seek(position - 1)
        if self._file.read(1) != b"\n":
            raise ValueError(
                f"{self.path} has no row that ends at byte {position}, where the checkpoint was "
                "taken: put the file back as the run left it, or start a new run."
            )
        self._file.truncate(position)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _line(self, row: Mapping[str, Any]) -> bytes:
        line = io.StringIO()
        csv.DictWriter(line, self.columns, lineterminator="\n").writerow(row)
        return line.getvalue().encode()

    def _append(self, line: bytes) -> None:
        start = self._file.seek(0, os.SEEK_END)
        try:
            # On a full disk, write() stores the part that fits without raising.
            if self._file.write(line) != len(line):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError as error:
            self._file.truncate(start)
            raise OSError(
                error.errno,
                f"cannot write to {self.path} ({error.strerror}): make room, then resume the run",
            ) from error


def plain_value(value: Any) -> Any:
    """Convert a one-element tensor or array to a Python number, and a boolean to 0 or 1."""
    if hasattr(value, "item"):
        value = value.item()
    return int(value) if isinstance(value, bool) else value
