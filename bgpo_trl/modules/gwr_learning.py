"""Learning of GWR-B: in-place changes of the weights ``[networks, capacity, d]``."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from bgpo_trl.modules.gwr_tensors import to_tensor
from bgpo_trl.modules.gwr_topology import LearningRule, Topology


def random_nodes(n_features: int, generator: torch.Generator | None) -> Tensor:
    """Draw the weights of a network's first two nodes uniformly from (-1, 1), ``[2, d]``."""
    device = None if generator is None else generator.device
    return 2 * torch.rand(2, n_features, generator=generator, device=device) - 1


def start(weights: Tensor, topology: Topology, initial: Tensor, rule: LearningRule) -> None:
    """Create the first node of a network, or the second and its edge (step 1 of `GWRB`)."""
    row = topology.add(rule.initial_habituation)
    weights[row] = initial
    if row > 0:
        topology.connect(0, row)


def learn(
    weights: Tensor,
    topologies: list[Topology],
    rule: LearningRule,
    phi: Tensor,
    embedding: Tensor,
    networks: list[int],
    n_before: list[int],
    nearest: list[tuple[int, int, float]],
) -> None:
    """Take steps 3 to 5 of `GWRB` in some of the networks.

    Args:
        weights: Of all networks.
        topologies: Of all networks.
        rule: The constants.
        phi: Inputs ``[A, d]``, one for each of ``networks``.
        embedding: Weights w_c of the best matches, ``[A, d]``.
        networks: Indices of the A networks that learn.
        n_before: Their numbers of nodes before this input.
        nearest: The rows of c and c' and the activity, for each of ``networks``.
    """
    inputs: list[int] = []
    rows: list[int] = []  # into the flattened weights
    steps: list[float] = []
    erased: list[int] = []
    for k, (i, n, match) in enumerate(zip(networks, n_before, nearest, strict=True)):
        if n < 2:
            if n == 1:
                start(weights[i], topologies[i], phi[k], rule)
            continue
        update = topologies[i].learn(*match, rule)
        if update.insert:
            new_row = len(topologies[i].identity) - 1
            weights[i, new_row] = (embedding[k] + phi[k]) / 2
        first = i * weights.shape[1]
        inputs += [k] * len(update.moved)
        rows += [first + row for row in update.moved]
        steps += update.steps
        erased += [first + row for row in update.removed]
    flat = weights.view(-1, weights.shape[-1])
    if rows:
        row, k = (to_tensor(x, torch.int64, phi.device) for x in (rows, inputs))
        step = to_tensor(steps, phi.dtype, phi.device).unsqueeze(-1)
        flat.index_copy_(0, row, flat.index_select(0, row).lerp(phi.index_select(0, k), step))
    if erased:
        flat[erased] = torch.inf


def with_room(weights: Tensor, topologies: list[Topology], networks: list[int]) -> Tensor:
    """Return the weights of all networks, with at least one spare row in each of ``networks``.

    A full network first reuses the rows of removed nodes, if these are at least an eighth of its
    rows. Otherwise the capacity grows by an eighth: proportionally, so that growth is cheap, but
    little, since every row is searched.
    """
    capacity = weights.shape[1]
    share = max(16, capacity // 8)
    full = [i for i in networks if len(topologies[i].identity) == capacity]
    if any(capacity - len(topologies[i].edges) < share for i in full):
        return nn.functional.pad(weights, (0, 0, 0, share), value=torch.inf)
    for i in full:
        rows = topologies[i].compact()
        weights[i, : len(rows)] = weights[i, rows]
        weights[i, len(rows) :] = torch.inf
    return weights
