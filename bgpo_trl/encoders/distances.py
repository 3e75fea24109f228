"""Distances between embedded demonstrations, in the scale of GWR-B's threshold."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def embedding_distances(
    phi: Tensor, task: Tensor, activity_threshold: float = 0.8
) -> dict[str, float]:
    """Measure the distances of embedded demonstrations relative to the threshold of GWR-B.

    GWR-B adds no node for a demonstration whose activity ``exp(-distance)`` at a node reaches a_T
    (Eq. 2, Table 1), so ``-ln a_T`` (0.223 for 0.8) is the reference distance: if all pairs are
    closer, the network never grows; if hardly any are, it adds a node per demonstration.

    Args:
        phi: Embeddings ``[N, embedding_size]``.
        task: Task labels, int64 ``[N]``.
        activity_threshold: Threshold a_T.

    Returns:
        ``phi_nearest_same_task`` and ``phi_nearest_other_task`` (median over demonstrations of the
        distance to the nearest one), ``phi_distance_same_task`` and ``phi_distance_other_task``
        (median over pairs), ``phi_threshold_distance`` (``-ln a_T``) and ``phi_nearest_known``
        (share of demonstrations whose nearest neighbor is closer than that). NaN without such
        pairs.
    """
    distance = torch.cdist(phi, phi, compute_mode="donot_use_mm_for_euclid_dist")
    itself = torch.eye(len(phi), dtype=torch.bool)
    same = (task.unsqueeze(0) == task.unsqueeze(1)) & ~itself
    other = task.unsqueeze(0) != task.unsqueeze(1)

    def nearest(mask: Tensor) -> Tensor:
        return distance.masked_fill(~mask, math.inf).amin(-1)

    threshold = -math.log(activity_threshold)
    return {
        "phi_nearest_same_task": _median(nearest(same)),
        "phi_nearest_other_task": _median(nearest(other)),
        "phi_distance_same_task": _median(distance[same]),
        "phi_distance_other_task": _median(distance[other]),
        "phi_threshold_distance": threshold,
        "phi_nearest_known": (nearest(~itself) < threshold).double().mean().item(),
    }


def _median(values: Tensor) -> float:
    values = values[values.isfinite()]
    return values.median().item() if values.numel() else math.nan
