"""Checkpoints that survive crashes: written atomically, verified on loading, never fewer than one.

A checkpoint is a file ``checkpoint-{number}-{digest}.pt``. As in ``torch.hub``'s file names,
``digest`` is the start of its SHA-256, since ``torch.load`` does not detect damaged bytes.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
import re
import warnings
from collections import OrderedDict
from pathlib import Path
from typing import Any, BinaryIO

import torch
from torch import Tensor, nn

_NAME = re.compile(r"checkpoint-\d+-[0-9a-f]{16}\.pt")
_REMEDY = "put it back as the run left it, or begin a new run in another directory"
_PLAIN_TYPES = (bool, int, float, str, type(None), Tensor, nn.Parameter)


def save_checkpoint(directory: str | os.PathLike[str], state: dict[str, Any]) -> Path:
    """Write a checkpoint, keep the one before it, and remove older ones.

    The file gets its name once it is complete on disk, so that a kill or a power cut at any moment
    leaves the previous checkpoint. Checkpoints are verified when they are loaded, not here: they
    may have gigabytes.

    Args:
        directory: Checkpoint folder of the run; made if it does not exist.
        state: Dicts, lists and tuples of tensors, numbers, strings, booleans and ``None``, nested
            as ``state_dict`` methods return them. Random generators are saved by their state:
            ``generator.get_state()`` or NumPy's ``generator.bit_generator.state``.

    Returns:
        The path of the checkpoint.

    Raises:
        ValueError: If the state holds any other type, which loading would refuse.
        OSError: If the file cannot be written, such as on a full disk; earlier checkpoints stay.

    Examples:
        >>> import tempfile
        >>> directory = tempfile.mkdtemp()
        >>> _ = save_checkpoint(directory, {"episode": 7, "weight": torch.ones(2)})
        >>> load_checkpoint(directory)
        {'episode': 7, 'weight': tensor([1., 1.])}
    """
    _check_state(state, "state")
    directory = Path(directory)
    temporary = directory / "checkpoint.tmp"
    earlier = _checkpoints(directory)
    number = _number(earlier[0]) + 1 if earlier else 1
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with temporary.open("wb") as file:
            digest = _write(state, file)
        path = directory / f"checkpoint-{number:06d}-{digest}.pt"
        temporary.replace(path)
        descriptor = os.open(directory, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except OSError as error:
        with contextlib.suppress(OSError):  # The directory may be missing or a file.
            temporary.unlink()
        raise OSError(
            error.errno,
            f"cannot save a checkpoint in {directory} ({error.strerror}), earlier ones are kept: "
            "make room, then resume the run",
        ) from error
    for old in earlier[1:]:
        old.unlink()
    return path


def load_checkpoint(
    directory: str | os.PathLike[str],
    *,
    map_location: str | torch.device = "cpu",
    mmap: bool = False,
    newest: bool = False,
) -> dict[str, Any]:
    """Read the newest intact checkpoint; warn about newer ones that are damaged.

    With ``mmap``, tensors are mapped from the file lazily, for reading only some of them. With
    ``newest``, only the newest one is read, for what is to be used as it is, not resumed.

    Raises:
        ValueError: If there is no intact checkpoint, or, with ``newest``, it is not the newest; or
            if the file is not a checkpoint of this package.
    """
    directory = Path(directory)
    for path in _checkpoints(directory):
        if _is_intact(path):
            return _read(path, map_location, mmap)
        if newest:
            raise ValueError(
                f"{path} is damaged, and older checkpoints have learned less: resume the run, "
                "which goes on from the one before"
            )
        warnings.warn(f"{path} is damaged: resuming from the checkpoint before it.", stacklevel=2)
    raise ValueError(
        f"{directory} holds no intact checkpoint to resume from: start a new run in another "
        "directory."
    )


def _read(path: Path, map_location: str | torch.device, mmap: bool) -> dict[str, Any]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of pickles that torch has not written
            state = torch.load(path, map_location=map_location, weights_only=True, mmap=mmap)
    except (pickle.UnpicklingError, RuntimeError, ValueError, EOFError) as error:
        raise ValueError(f"{path} is not a checkpoint: {_REMEDY}") from error
    if not isinstance(state, dict):
        raise ValueError(f"{path} holds a {type(state).__name__}, not a checkpoint: {_REMEDY}")
    return state


def has_checkpoint(directory: str | os.PathLike[str]) -> bool:
    """Return whether a directory holds a checkpoint, intact or not."""
    return bool(_checkpoints(Path(directory)))


class _HashingFile:
    """Hash the bytes written, and keep the ``OSError`` that ``torch.save`` would hide."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.sha256 = hashlib.sha256()
        self.error: OSError | None = None

    def write(self, data: Any) -> int:
        try:
            written = self._file.write(data)
        except OSError as error:
            self.error = error
            raise
        self.sha256.update(data)
        return written

    def flush(self) -> None:
        self._file.flush()


def _write(state: dict[str, Any], file: BinaryIO) -> str:
    hashing_file = _HashingFile(file)
    try:
        torch.save(state, hashing_file)  # pyright: ignore[reportArgumentType]
    except RuntimeError:
        if hashing_file.error is not None:
            raise hashing_file.error from None
        raise
    file.flush()
    os.fsync(file.fileno())
    return hashing_file.sha256.hexdigest()[:16]


def _number(path: Path) -> int:
    return int(path.stem.split("-")[1])


def _checkpoints(directory: Path) -> list[Path]:
    """Return the checkpoints in a directory, newest first."""
    found = [path for path in directory.glob("checkpoint-*.pt") if _NAME.fullmatch(path.name)]
    return sorted(found, key=_number, reverse=True)


def _is_intact(path: Path) -> bool:
    with open(path, "rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return digest.startswith(path.stem.split("-")[2])


def _check_state(value: Any, where: str) -> None:
    # Exact types: subclasses such as numpy.float64 or a memory-mapped tensor are pickled with
    # their class, which torch.load(weights_only=True) refuses.
    if type(value) in (dict, OrderedDict):
        for key, item in value.items():
            if type(key) not in (str, int):
                raise ValueError(f"{where} has the key {key!r}: a checkpoint takes str and int.")
            _check_state(item, f"{where}[{key!r}]")
    elif type(value) in (list, tuple):
        for index, item in enumerate(value):
            _check_state(item, f"{where}[{index}]")
    elif type(value) not in _PLAIN_TYPES:
        raise ValueError(
            f"{where} is a {type(value).__name__}, which a checkpoint cannot hold: turn it into "
            "tensors, numbers, strings, lists or dicts."
        )
