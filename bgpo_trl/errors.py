"""Checks of arguments and error messages that several packages share."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from numbers import Integral
from pathlib import Path

import torch
from tensordict import NestedKey, TensorDictBase

_LFS = b"version https://git-lfs"


class UnreadableError(ValueError):
    """A file cannot be taken as it is; the message says why."""


def check_fetched(path: Path) -> None:
    """Raise `UnreadableError` if a file is a pointer of Git LFS, left by a clone without it."""
    if path.is_file():
        with path.open("rb") as file:
            if file.read(len(_LFS)) == _LFS:
                raise UnreadableError(
                    f"{path} is a pointer of Git LFS: get the file itself, git lfs pull"
                )


def missing_key(
    reader: object, tensordict: TensorDictBase, keys: Iterable[NestedKey]
) -> ValueError:
    """Return the error to raise in place of a `KeyError` when entries are missing.

    Args:
        reader: Name of the class that reads the entries, the first word of the message.
        tensordict: TensorDict that lacks some of them.
        keys: All entries that are read; those present are left out of the message.

    Examples:
        >>> from tensordict import TensorDict
        >>> print(missing_key("Actor", TensorDict({"latent": 0.0}), ["latent", "behavior"]))
        Actor found no 'behavior' in a TensorDict with ['latent']: write it before, or name another
        entry
    """
    there = set(tensordict.keys(True))
    missing = [key for key in keys if key not in there]
    return ValueError(
        f"{reader} found no {', '.join(map(repr, missing))} in a TensorDict with "
        f"{sorted(map(str, tensordict.keys()))}: write it before, or name another entry"
    )


def as_shape(value: int | Sequence[int], name: str) -> torch.Size:
    """Return sizes as a shape; raise ``ValueError`` unless they are whole numbers of at least 1."""
    sizes = list(value) if isinstance(value, Sequence) else [value]
    if not all(isinstance(size, Integral) and size >= 1 for size in sizes):
        got = ", ".join(map(repr, sizes))
        raise ValueError(f"{name} must be a whole number, at least 1; got {got}")
    return torch.Size(sizes)
