"""Checkpoints that survive crashes: written atomically, verified on loading, never fewer than one.

A checkpoint is a file ``checkpoint-{number}.pt``, a ZIP archive. ``torch.load`` does not compare
the checksums in it, hence they are compared before.
"""

from __future__ import annotations

import contextlib
import os
import warnings
import zipfile
from collections import OrderedDict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

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
    check_state(state, "state")
    directory = Path(directory)
    temporary = directory / "checkpoint.tmp"
    earlier = _checkpoints(directory)
    number = _number(earlier[0]) + 1 if earlier else 1
    try:
        directory.mkdir(parents=True, exist_ok=True)
        torch.save(state, temporary)
        _flush(temporary)
        path = directory / f"checkpoint-{number:06d}.pt"
        temporary.replace(path)
        _flush(directory)
    except (OSError, RuntimeError) as error:  # RuntimeError: torch.save, on a full disk.
        with contextlib.suppress(OSError):  # The directory may be missing or a file.
            temporary.unlink()
        raise OSError(
            f"cannot save a checkpoint in {directory} ({str(error).splitlines()[0]}), earlier ones "
            "are kept: make room, then resume the run"
        ) from error
    for old in earlier[1:]:
        old.unlink()
    return path


def load_checkpoint(
    directory: str | os.PathLike[str],
    *,
    mmap: bool = False,
    newest: bool = False,
) -> dict[str, Any]:
    """Read the newest intact checkpoint to the CPU; warn about newer ones that are damaged.

    With ``mmap``, tensors are mapped from the file lazily, for reading only some of them. With
    ``newest``, only the newest one is read, for what is to be used as it is, not resumed.

    Raises:
        ValueError: If there is no intact checkpoint, or, with ``newest``, it is not the newest.
    """
    directory = Path(directory)
    for path in _checkpoints(directory):
        state = _read(path, mmap)
        if state is not None:
            return state
        if newest:
            raise ValueError(
                f"{path} is damaged, and older checkpoints have learned less: resume the run, "
                "which goes on from the one before"
            )
        warnings.warn(f"{path} is damaged: resuming from the checkpoint before it.", stacklevel=2)
    raise ValueError(
        f"{directory} holds no intact checkpoint: let the run reach its first one, put it back as "
        "the run left it, or start a new run in another directory"
    )


def _read(path: Path, mmap: bool) -> dict[str, Any] | None:
    """Return the content of a checkpoint; None if it is damaged, or not one."""
    try:
        with zipfile.ZipFile(path) as file:
            if file.testzip() is not None:
                return None
        state = torch.load(path, map_location="cpu", weights_only=True, mmap=mmap)
    except Exception:  # Damage raises errors of many kinds.
        return None
    return state if isinstance(state, dict) else None


def has_checkpoint(directory: str | os.PathLike[str]) -> bool:
    """Return whether a directory holds a checkpoint, intact or not."""
    return bool(_checkpoints(Path(directory)))


def _flush(path: Path) -> None:
    """Have a file or folder written to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _number(path: Path) -> int:
    return int(path.stem.split("-")[1])


def _checkpoints(directory: Path) -> list[Path]:
    """Return the checkpoints in a directory, newest first."""
    return sorted(directory.glob("checkpoint-[0-9]*.pt"), key=_number, reverse=True)


def check_state(value: Any, where: str) -> None:
    """Raise ``ValueError`` unless a checkpoint can hold a value, ``where`` it stands."""
    # Exact types: subclasses such as numpy.float64 or a memory-mapped tensor are pickled with
    # their class, which torch.load(weights_only=True) refuses.
    if type(value) in (dict, OrderedDict):
        for key, item in value.items():
            if type(key) not in (str, int):
                raise ValueError(f"{where} has the key {key!r}: a checkpoint takes str and int.")
            check_state(item, f"{where}[{key!r}]")
    elif type(value) in (list, tuple):
        for index, item in enumerate(value):
            check_state(item, f"{where}[{index}]")
    elif type(value) not in _PLAIN_TYPES:
        raise ValueError(
            f"{where} is a {type(value).__name__}, which a checkpoint cannot hold: turn it into "
            "tensors, numbers, strings, lists or dicts."
        )
