"""Independent, named streams of random numbers from one seed."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral
from operator import index
from typing import Any

import numpy as np
import torch
from torch import Tensor


def stream_seed(seed: int, name: str) -> int:
    """Return a seed below 2**32 for a stream such as ``"exploration"``, given the run's seed."""
    sequence = np.random.SeedSequence([seed, zlib.crc32(name.encode())])
    return int(sequence.generate_state(1)[0])


def generators(seeds: Sequence[int], name: str) -> list[torch.Generator]:
    """Return one generator per seed for a named stream, the same alone as in any batch.

    Examples:
        >>> alone, = generators([7], "exploration")
        >>> _, in_batch = generators([3, 7], "exploration")
        >>> bool((torch.rand(4, generator=alone) == torch.rand(4, generator=in_batch)).all())
        True
    """
    return [torch.Generator().manual_seed(stream_seed(seed, name)) for seed in seeds]


def row_seeds(seed: int | Iterable[int] | None, count: int) -> list[int]:
    """Return a seed in ``[0, 2**32)`` for each row of a batch.

    Args:
        seed: Seed of the first row, from which the others count up; or one for each row; or None
            for seeds from the operating system.
        count: Number of rows.

    Raises:
        ValueError: If there are not as many seeds as rows, or one is out of range.

    Examples:
        >>> row_seeds(7, 3), row_seeds([5, 2], 2)
        ([7, 8, 9], [5, 2])
    """
    if seed is None:
        return np.random.SeedSequence().generate_state(count).tolist()
    counted = isinstance(seed, (int, Integral))
    seeds = [index(seed)] if counted else [index(each) for each in seed]
    if not counted and len(seeds) != count:
        raise ValueError(f"{len(seeds)} seeds for {count} simulations: give one each")
    if not all(0 <= each < 2**32 for each in seeds):
        raise ValueError(f"a seed must lie in 0..2**32 - 1, got {seed}")
    return [(seeds[0] + row) % 2**32 for row in range(count)] if counted else seeds


def one_each(
    generator: torch.Generator | Sequence[torch.Generator] | None, count: int
) -> Sequence[torch.Generator | None]:
    """Return a source of random numbers for each of ``count`` things.

    ``generator`` is one for all, one for each, or None for torch's default generator; raise
    ``ValueError`` if there are not as many, or they are something else.
    """
    sources = generator if isinstance(generator, Sequence) else [generator] * count
    kinds = (torch.Generator, type(None))
    if len(sources) != count or not all(isinstance(source, kinds) for source in sources):
        raise ValueError(f"generator must be a torch.Generator, or a sequence of {count}, one each")
    return sources


@dataclass(frozen=True, eq=False)
class Seeding:
    """Mark of one call of ``set_seed``; two calls with the same seed are distinct.

    Attributes:
        seeds: A seed for each row.
    """

    seeds: tuple[int, ...]


def normal(generators: Sequence[torch.Generator], shape: Sequence[int]) -> Tensor:
    """Return standard normals ``[S, *shape]``, each seed's from its own generator."""
    return torch.stack([torch.randn(*shape, generator=generator) for generator in generators])


def random_state(random: np.random.RandomState) -> dict[str, Any]:
    """Return the state of NumPy's generator in a form that checkpoints can hold."""
    state = random.get_state(legacy=False)
    return {
        "key": torch.from_numpy(state["state"]["key"].astype(np.int64)),
        "position": int(state["state"]["pos"]),
        "has_gauss": int(state["has_gauss"]),
        "gauss": float(state["gauss"]),
    }


def set_random_state(random: np.random.RandomState, state: Mapping[str, Any]) -> None:
    """Restore the result of `random_state`."""
    key = state["key"].numpy().astype(np.uint32)
    random.set_state(("MT19937", key, state["position"], state["has_gauss"], state["gauss"]))
