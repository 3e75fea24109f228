"""Arguments of GWR-B as checked tensors, and distances to its nodes."""

from __future__ import annotations

from collections.abc import Sequence
from reprlib import repr as short_repr
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

Numbers: TypeAlias = Tensor | npt.ArrayLike


def as_generators(
    value: torch.Generator | Sequence[torch.Generator] | None, count: int
) -> Sequence[torch.Generator | None]:
    """Return one generator (or None) per network; raise ``ValueError`` if there are others."""
    generators = value if isinstance(value, Sequence) else [value] * count
    if len(generators) != count or not all(
        generator is None or isinstance(generator, torch.Generator) for generator in generators
    ):
        raise ValueError(
            f"generator must be a torch.Generator, or a sequence of {count}, one a network"
        )
    return generators


def as_tensor(value: Numbers, name: str) -> Tensor:
    """Return numbers as a tensor of their own dtype; raise ``ValueError`` for anything else."""
    if isinstance(value, Tensor):
        return value
    try:
        # Copied: torch accepts neither negative strides nor read-only memory.
        return torch.from_numpy(np.array(value))
    except (TypeError, ValueError, RuntimeError):
        raise ValueError(
            f"{name} must be a tensor, an array, or lists of equal lengths, of numbers; "
            f"got {short_repr(value)}"
        ) from None


def as_mask(value: Numbers, shape: torch.Size) -> Tensor:
    """Return a mask as a tensor; raise ``ValueError`` unless it is bool and of that shape."""
    mask = as_tensor(value, "mask")
    if mask.shape != shape or mask.dtype != torch.bool:
        raise ValueError(f"mask must be bool {[*shape]}; got {mask.dtype} {[*mask.shape]}")
    return mask


def checked(phi: Tensor, weights: Tensor, name: str = "phi") -> Tensor:
    """Return an input in the dtype and on the device of the weights, without gradient.

    Raises:
        ValueError: If it is complex, not finite, or so large that squared distances overflow.
    """
    if phi.is_complex():
        raise ValueError(f"{name} must be real numbers; got complex ones")
    phi = phi.detach().to(weights)
    # Beyond this limit a squared distance could overflow, making all nodes equally near.
    limit = torch.finfo(phi.dtype).max ** 0.5 / 2
    if not torch.linalg.vector_norm(phi).item() <= limit:
        raise ValueError(f"{name} must be free of NaN, Inf and values beyond +-{limit:.0e}")
    return phi


def pairwise_distances(phi: Tensor, weights: Tensor) -> Tensor:
    """Return the distances ``[A, M, N]`` of inputs ``[A, M, d]`` to nodes ``[A, N, d]``."""
    # The default of cdist, a matrix product, is off by 1e-3 near a distance of 0.
    return torch.cdist(phi, weights, compute_mode="donot_use_mm_for_euclid_dist")


def to_tensor(numbers: list[Any], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return a list of numbers as a tensor; by way of NumPy, four times as fast."""
    return torch.as_tensor(np.array(numbers), dtype=dtype, device=device)


def scattered(results: Sequence[Tensor], network: Tensor, n_networks: int) -> list[Tensor]:
    """Return results of all networks: those of ``network``, and NaN (nodes: -1) of the others."""
    fills = [torch.nan if x.is_floating_point() else -1 for x in results]
    return [
        x.new_full((n_networks, *x.shape[1:]), fill).index_copy(0, network, x)
        for x, fill in zip(results, fills, strict=True)
    ]
