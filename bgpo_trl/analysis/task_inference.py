"""Task inference of GWR-B and purity of the groups, measured with labels that they never see.

Tasks count alike, however many demonstrations a bank holds of each.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.modules.behavior_groups import BehaviorGroups
from bgpo_trl.modules.gwr import GWRB


@torch.no_grad()
def match_counts(gwr: GWRB, bank: DemonstrationBank) -> Tensor:
    """Count the demonstrations of each task whose best-matching unit is a node.

    Returns:
        Counts int64 ``[*S, N, T]`` of networks ``[*S]``, with nodes in order of creation and
        ``N`` the size of the largest network; rows beyond a smaller network's size are 0.
    """
    node = gwr.lookup(bank.embedding.expand(*gwr.batch_size, *bank.embedding.shape)).node
    shape = (*gwr.batch_size, int(gwr.num_nodes.max()), len(bank.tasks))
    counts = torch.zeros(shape, dtype=torch.int64)
    for index in np.ndindex(*gwr.batch_size):
        position = torch.searchsorted(gwr.graph(index).node, node[index])
        counts[index].index_put_((position, bank.task), torch.tensor(1), accumulate=True)
    return counts


def majority_task(counts: Tensor) -> Tensor:
    """Return the task of which a node matches most, int64 ``[..., N]``, from its `match_counts`.

    Nodes without a match get -1.
    """
    return torch.where(counts.sum(-1) > 0, _shares(counts).argmax(-1), -1)


def _shares(counts: Tensor) -> Tensor:
    """Return counts ``[..., N, T]`` as shares of each task's demonstrations."""
    return counts / counts.sum(-2, keepdim=True).clamp(min=1)


def task_inference_accuracy(
    gwr: GWRB, seen: DemonstrationBank, tested: DemonstrationBank
) -> Tensor:
    """Return the share of ``tested`` whose node has their task as its majority task, ``[*S]``.

    It is the mean over the tasks. The demonstrations ``seen`` define each node's majority task.
    """
    task_of_node = majority_task(match_counts(gwr, seen))
    matched = _shares(match_counts(gwr, tested))
    right = matched.gather(-1, task_of_node.clamp(min=0).unsqueeze(-1)).squeeze(-1)
    right = torch.where(task_of_node >= 0, right, 0.0)
    return right.sum(-1) / len(tested.task.unique())


def group_counts(group: Tensor, task: Tensor) -> Tensor:
    """Count demonstrations by their group and task, float32 ``[G, T]``."""
    counts = torch.zeros(int(group.max()) + 1, int(task.max()) + 1)
    return counts.index_put_((group, task), torch.tensor(1.0), accumulate=True)


@torch.no_grad()
def group_purity(groups: BehaviorGroups, bank: DemonstrationBank) -> float:
    """Return the share of demonstrations of the majority task of their group.

    A group's majority task is that of which it holds the largest share.
    """
    counts = group_counts(groups.lookup(bank.embedding).group, bank.task)
    return float(_shares(counts).amax(-1).sum(-1) / len(bank.task.unique()))
