"""CSV files that survive what happens to long runs: kills, full disks and resumed runs."""

from __future__ import annotations

import csv
import errno
import io
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self


class CsvFile:
    r"""An append-only CSV file with fixed columns that can be cut back to an earlier position.

    Rows go to the operating system one by one, unbuffered and whole: killing the process loses no
    row, a row that does not fit on the disk leaves no trace, and half a row that a crashed machine
    left at the end is dropped on opening. Tensors and NumPy values of one element are written as
    numbers, booleans as 0 and 1, floats so that reading gives the same float back.

    Args:
        path: The file; an existing one is continued.
        columns: Names of the columns, the first line of the file.

    Raises:
        ValueError: If the file exists with other columns, or two columns have the same name.
        OSError: If the file cannot be written.

    Example:
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
        self.path = Path(path)
        self.columns = tuple(columns)
        if not self.columns or len(set(self.columns)) < len(self.columns):
            raise ValueError(f"{self.path.name} needs columns, all different: got {self.columns}")
        header = _csv_line(self.columns)
        self._header_size = len(header)
        try:
            self._file = open(self.path, "a+b", buffering=0)  # noqa: SIM115 closed by close()
        except OSError as error:
            raise OSError(
                f"cannot write {self.path} ({error.strerror}): choose another run directory"
            ) from None
        try:
            self._file.seek(0)
            content = self._file.read()
            if not header.startswith(content[: len(header)]):
                found = content[:300].partition(b"\n")[0].decode(errors="replace").strip()
                # What is no text would do to a terminal whatever its bytes mean there.
                text = found.isascii() and found.isprintable()
                raise ValueError(
                    f"{self.path} {f'has the columns {found}' if text else 'is no CSV file'}, this "
                    f"run writes {','.join(self.columns)}: choose another run directory."
                )
            self._file.truncate(content.rfind(b"\n") + 1)
            if len(content) < len(header):
                self._append(header)
        except BaseException:
            self._file.close()
            raise

    def write(self, row: Mapping[str, Any]) -> None:
        """Appends a row; a column without a value stays empty.

        Args:
            row: Values by column.

        Raises:
            ValueError: If the row has a value for a column that the file does not have.
            OSError: If the row cannot be written; the file then ends with the row before.
        """
        unknown = [name for name in row if name not in self.columns]
        if unknown:
            raise ValueError(
                f"{self.path.name} has no column {', '.join(unknown)}: name it when the run is "
                f"created, or write only {', '.join(self.columns)}."
            )
        self._append(_csv_line([plain_value(row.get(name)) for name in self.columns]))

    def position(self) -> int:
        """Returns the size of the file in bytes, after making sure that the disk has it all."""
        os.fsync(self._file.fileno())
        return self._file.seek(0, os.SEEK_END)

    def truncate_to(self, position: int) -> None:
        """Drops all rows written after a position.

        Args:
            position: What :meth:`position` returned. 0 drops all rows and keeps the header.

        Raises:
            ValueError: If the file is shorter than that, or the position is not the end of a row.
        """
        position = max(position, self._header_size)
        check_position(self.path, position)
        self._file.truncate(position)

    def close(self) -> None:
        """Closes the file; further writes are errors."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc_value: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _append(self, line: bytes) -> None:
        start = self._file.seek(0, os.SEEK_END)
        try:
            # A disk that fills up takes the part of a line that fits, and reports no error.
            if self._file.write(line) != len(line):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError as error:
            self._file.truncate(start)
            raise OSError(
                error.errno,
                f"cannot write to {self.path} ({error.strerror}): make room, then resume the run",
            ) from error


def has_rows(path: str | os.PathLike[str]) -> bool:
    """Returns whether there is a CSV file with more than its header."""
    try:
        with open(path, "rb") as file:
            return bool(file.readline() and file.read(1))
    except OSError:
        return False


def check_position(path: str | os.PathLike[str], position: int) -> None:
    """Makes sure that a file has a row that ends at a position.

    Args:
        path: The file, there or not.
        position: In bytes, at least 1.

    Raises:
        ValueError: If it has none.
    """
    path = Path(path)
    size = path.stat().st_size if path.exists() else 0
    if position <= size:
        with path.open("rb") as file:
            file.seek(position - 1)
            if file.read(1) == b"\n":
                return
    raise ValueError(
        f"{path} has {size} bytes and no row that ends at byte {position}, where the checkpoint "
        "was taken: put the file back as the run left it, or start a new run."
    )


def plain_value(value: Any) -> Any:
    """Returns the Python number in a tensor or array of one element, and a boolean as 0 or 1."""
    if hasattr(value, "item"):
        value = value.item()
    return int(value) if isinstance(value, bool) else value


def _csv_line(fields: Sequence[Any]) -> bytes:
    line = io.StringIO()
    csv.writer(line, lineterminator="\n").writerow(fields)
    return line.getvalue().encode()
