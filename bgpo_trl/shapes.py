"""Shapes given as arguments."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Integral

import torch


def as_shape(value: int | Sequence[int], name: str) -> torch.Size:
    """Return sizes as a shape; raise ``ValueError`` unless they are whole numbers of at least 1."""
    sizes = list(value) if isinstance(value, Sequence) else [value]
    if not all(isinstance(size, Integral) and size >= 1 for size in sizes):
        got = ", ".join(map(repr, sizes))
        raise ValueError(f"{name} must be a whole number, at least 1; got {got}")
    return torch.Size(sizes)
