"""Groups of behaviors that form from the demonstrations of a bank, without learning a policy.

    python benchmarks/groups.py
    python benchmarks/groups.py --bank my_bank.safetensors --tasks all --draws 4000

feeds networks with demonstrations in the order of training episodes, tasks one after the other and
all from the start, and prints by activity threshold how many groups form and how pure they are on
held-out demonstrations; also in how many of these GWR-B infers the task.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
import torch
from torch import Tensor

from bgpo_trl.analysis.task_inference import group_purity, task_inference_accuracy
from bgpo_trl.configs import BGPOConfig, GWRBConfig
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.encoders.shipped import default_weights, groups_config
from bgpo_trl.experiments.arguments import BankArguments, check_draws, command_line, even_starts
from bgpo_trl.experiments.run import bank_of
from bgpo_trl.modules.behavior_groups import BehaviorGroups
from bgpo_trl.modules.gwr import GWRB
from bgpo_trl.seeding import generators


@dataclass(frozen=True)
class Arguments(BankArguments):
    """Measure the groups of behaviors that form from demonstrations."""

    thresholds: tuple[float, ...] = (0.5, 0.525, 0.55, 0.575, 0.6)
    """Activity thresholds of the coarse network."""
    habituation_threshold: float = 0.5
    """Habituation threshold of the coarse network."""
    activity_scale: float = GWRBConfig.activity_scale
    """Factor of distances in the activity of the fine network."""
    draws: int = 1_800
    """Demonstrations that each network is fed with."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4, 5)
    """Seeds of the draws."""


def draw(
    bank: DemonstrationBank, starts: Sequence[int], *, draws: int, seeds: Sequence[int]
) -> Tensor:
    """Draw demonstrations as training episodes do, int64 ``[draws, S]`` rows of the bank."""
    of_task = [np.flatnonzero(bank.task == task) for task in range(len(starts))]
    rows = np.empty((draws, len(seeds)), np.int64)
    for column, seed in zip(rows.T, seeds, strict=True):
        rng = np.random.default_rng(seed)
        for episode in range(draws):
            presented = [task for task, start in enumerate(starts) if start <= episode]
            column[episode] = rng.choice(of_task[rng.choice(presented)])
    return torch.from_numpy(rows)


def main(arguments: Arguments) -> None:
    """Print the table."""
    torch.set_num_threads(1)
    check_draws(arguments.seeds, arguments.draws)
    bank = bank_of(arguments)
    n_tasks, seeds = len(bank.tasks), arguments.seeds
    fine = replace(BGPOConfig().gwr, activity_scale=arguments.activity_scale)
    coarse = replace(
        groups_config(default_weights()), habituation_threshold=arguments.habituation_threshold
    )
    settings = [replace(coarse, activity_threshold=a_t) for a_t in arguments.thresholds]
    seen, held_out = bank.seen(), bank.held_out()
    print("| order | network | a_T | groups or nodes, by seed | purity or inference, % |")
    print("|---|---|---:|---|---|")
    orders = {
        "one after the other": even_starts(n_tasks, arguments.draws),
        "from the start": (0,) * n_tasks,
    }
    for order, starts in orders.items():
        inputs = seen.embedding[draw(seen, starts, draws=arguments.draws, seeds=seeds)]
        random = generators(seeds, "gwr")
        gwr = GWRB(32, batch_size=len(seeds), generator=random, **asdict(fine))
        for x in inputs:
            gwr.adapt(x)
        right = task_inference_accuracy(gwr, seen, held_out, n_tasks)
        print(row(order, "fine", fine.activity_threshold, gwr.num_nodes, right))
        for setting in settings:
            groups = BehaviorGroups(32, batch_size=len(seeds), **asdict(setting))
            for x in inputs:
                groups.adapt(x)
            purity = group_purity(groups, held_out, n_tasks)
            threshold = setting.activity_threshold
            print(row(order, "coarse", threshold, groups.num_groups, purity), flush=True)


def row(order: str, network: str, threshold: float, counts: Tensor, shares: Tensor) -> str:
    """Format a row of the table."""
    numbers = " ".join(str(count) for count in counts.tolist())
    percent = " ".join(f"{100 * share:.4g}" for share in shares.tolist())
    return f"| {order} | {network} | {threshold} | {numbers} | {percent} |"


if __name__ == "__main__":
    command_line(main, __doc__, Arguments)
