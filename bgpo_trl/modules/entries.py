"""Entries that are read from a TensorDict: one that is missing is told with what to do."""

from __future__ import annotations

from collections.abc import Iterable

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor


def lacking(reader: object, tensordict: TensorDictBase, keys: Iterable[NestedKey]) -> ValueError:
    """Return the error to be raised in place of a `KeyError`.

    Args:
        reader: Name of what wanted to read.
        tensordict: Where from.
        keys: What it reads; some of it is missing.
    """
    there = set(tensordict.keys(True))
    missing = [key for key in keys if key not in there]
    return ValueError(
        f"{reader} found no {', '.join(map(repr, missing))} in a TensorDict with "
        f"{sorted(map(str, tensordict.keys()))}: write it before, or name another entry"
    )


def read(reader: TensorDictModuleBase, tensordict: TensorDictBase) -> list[Tensor]:
    """Return the ``in_keys`` of a network.

    Raises:
        ValueError: If one is missing.
    """
    try:
        return [tensordict[key] for key in reader.in_keys]
    except KeyError:
        raise lacking(reader.__class__.__name__, tensordict, reader.in_keys) from None
