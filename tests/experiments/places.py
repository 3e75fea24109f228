"""Demonstrations of tasks that lie apart."""

import torch

from bgpo_trl.data.bank import DemonstrationBank


def places(*centers, n=40, spread=0.05):
    """A bank with one task around each center, every fourth demonstration held out."""
    generator = torch.Generator().manual_seed(1)
    task = torch.arange(len(centers)).repeat_interleave(n)
    noise = spread * torch.randn(len(task), 2, generator=generator)
    embedding = torch.tensor(centers)[task] + noise
    train = torch.arange(len(task)) % 4 != 0
    names = tuple(f"task{i}" for i in range(len(centers)))
    return DemonstrationBank(embedding, task, train, names)
