"""Groups of behaviors that form from demonstrations, and their purity."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np
import torch
from torch import Tensor

from bgpo_trl.analysis.tables import Table, markdown
from bgpo_trl.analysis.task_inference import group_counts, group_purity, task_inference_accuracy
from bgpo_trl.configs import BGPOConfig
from bgpo_trl.configs.runs import check_seeds
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.experiments.arguments import GroupsArguments
from bgpo_trl.experiments.run import bank_of
from bgpo_trl.experiments.settings import even_starts
from bgpo_trl.modules.behavior_groups import BehaviorGroups
from bgpo_trl.modules.gwr import GWRB
from bgpo_trl.seeding import generators
from bgpo_trl.transforms import TaskSchedule


def draw(bank: DemonstrationBank, schedule: TaskSchedule, draws: int, seed: int) -> Iterator[int]:
    """Draw demonstrations as training episodes do: rows of the bank."""
    of_task = [np.flatnonzero(bank.task == task) for task in range(schedule.n_tasks)]
    rng = np.random.default_rng(seed)
    for available in schedule.available(torch.arange(draws)):
        yield int(rng.choice(of_task[rng.choice(available.nonzero().flatten())]))


def own_groups(group: Tensor, task: Tensor) -> set[int]:
    """Return the tasks most of whose demonstrations are in a group that holds mostly theirs."""
    counts = group_counts(group, task)
    largest = counts.argmax(0)
    is_own = counts[largest].argmax(-1) == torch.arange(len(largest))
    return {*(is_own & (counts.sum(0) > 0)).nonzero().flatten().tolist()}


def sharing(group: Tensor, task: Tensor) -> set[tuple[int, int]]:
    """Return the pairs of tasks of which one group holds more than a tenth each."""
    counts = group_counts(group, task)
    held = counts / counts.sum(0).clamp(min=1) > 0.1
    return {pair for row in held for pair in combinations(row.nonzero().flatten().tolist(), 2)}


def form(
    bank: DemonstrationBank, rows: Sequence[int], config: BGPOConfig
) -> tuple[BehaviorGroups, dict[int, int], float]:
    """Let groups form.

    Returns:
        The groups; by task, the number of its different demonstrations when it first had a group of
        its own; seconds.
    """
    groups = BehaviorGroups(
        bank.embedding.shape[-1], smallest=config.group_size, evidence=config.group_evidence
    )
    shown: dict[int, None] = {}
    needed: dict[int, int] = {}
    seconds, revision = 0.0, -1
    for row in rows:
        shown[row] = None
        begun = time.perf_counter()
        groups.adapt(bank.embedding[row])
        seconds += time.perf_counter() - begun
        if groups.revision == revision:
            continue
        revision = groups.revision
        so_far = torch.tensor([*shown])
        task = bank.task[so_far]
        for own in own_groups(groups.lookup(bank.embedding[so_far]).group, task) - needed.keys():
            needed[own] = int((task == own).sum())
    return groups, needed, seconds


def groups(arguments: GroupsArguments) -> str:
    """Measure the groups of behaviors that form from demonstrations, as `GroupsArguments` says."""
    torch.set_num_threads(1)
    if arguments.draws < 1:
        raise ValueError(f"--draws must be at least 1, got {arguments.draws}")
    check_seeds(arguments.seeds)
    bank, config = bank_of(arguments), BGPOConfig(group_evidence=arguments.group_evidence)
    n_tasks, seen, held_out = len(bank.tasks), bank.seen(), bank.held_out()
    forward = even_starts(n_tasks, arguments.draws)
    schedules = {
        "one after the other": TaskSchedule(forward),
        "in reverse": TaskSchedule(forward[::-1]),
        "the newest only": TaskSchedule(forward, cumulative=False),
        "from the start": TaskSchedule((0,) * n_tasks),
    }
    table: Table = [
        ["order", "groups, by seed", "purity, %", "needed", "seconds", "nodes", "inferred, %"]
    ]
    shared: Counter[tuple[int, int]] = Counter()
    for order, schedule in schedules.items():
        columns: list[list[str]] = []
        for seed in arguments.seeds:
            rows = [*draw(seen, schedule, arguments.draws, seed)]
            formed, needed, seconds = form(seen, rows, config)
            shared.update(sharing(formed.lookup(held_out.embedding).group, held_out.task))
            (random,) = generators([seed], "gwr")
            gwr = GWRB(seen.embedding.shape[-1], config.gwr, generator=random)
            for row in rows:
                gwr.adapt(seen.embedding[row])
            inferred = task_inference_accuracy(gwr, seen, held_out)
            columns.append(
                [
                    f"{len(formed.numbers)}",
                    f"{100 * group_purity(formed, held_out):.4g}",
                    f"{max(needed.values())}" if len(needed) == n_tasks else "never",
                    f"{seconds:.1f}",
                    f"{int(gwr.num_nodes)}",
                    f"{100 * float(inferred):.4g}",
                ]
            )
        table.append([order, *(" ".join(column) for column in zip(*columns, strict=True))])
    n_networks = len(schedules) * len(arguments.seeds)
    lines = [
        f"{bank.tasks[one]} and {bank.tasks[other]} share a group in {count} of {n_networks}: show "
        "more demonstrations, train better encoders (`bgpo probes` says what they lack), or lower "
        "--group-evidence."
        for (one, other), count in shared.most_common()
    ]
    return "\n".join([markdown(table), "", *lines]).rstrip()
