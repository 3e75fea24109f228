r"""Measure what BGPO infers from demonstrations that are cut short, of known and of unknown tasks.

No policy is learned: GWR-B and the groups of behaviors grow from training demonstrations, all tasks
from the start. New demonstrations are recorded and cut after shares of their frames.

    python benchmarks/studies/cut_demonstrations.py benchmarks/results/cut-demonstrations
    python benchmarks/studies/cut_demonstrations.py benchmarks/results/cut-demonstrations-eight \
        --tasks all --draws 3200

Writes ``known.csv`` (by share, seed and task: in which share of demonstrations the node and the
group are those of the task, the activity, and the share that belongs to no known group) and
``unknown.csv`` (by task left out, share and seed: how well novelty tells the task from the others),
and prints both as tables of means over seeds.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import torch
import tyro
from scipy import stats
from torch import Tensor

from bgpo_trl.analysis.tables import Table, markdown
from bgpo_trl.analysis.task_inference import group_counts, majority_task
from bgpo_trl.configs import BGPOConfig
from bgpo_trl.configs.runs import check_seeds
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.data.recording import new_demonstrations
from bgpo_trl.encoders.pretrained import load_pretrained
from bgpo_trl.encoders.representation import encode_frames
from bgpo_trl.experiments.command_line import command_line
from bgpo_trl.experiments.settings import chosen_tasks
from bgpo_trl.files.writing import make_folder
from bgpo_trl.modules.behavior_groups import BehaviorGroups
from bgpo_trl.modules.gwr import GWRB
from bgpo_trl.runs.provenance import write_table
from bgpo_trl.scenes.nico import NICO
from bgpo_trl.seeding import generators, stream_seed


@dataclass(frozen=True)
class Arguments:
    """Demonstrations that are cut short."""

    out: tyro.conf.Positional[Path]
    """Folder of the results."""
    tasks: tuple[str, ...] = NICO.default_tasks
    """Names of the tasks, or "all"."""
    draws: int = 1_800
    """Demonstrations that each network is shown."""
    per_task: int = 100
    """New demonstrations of each task."""
    shares: tuple[float, ...] = (0.25, 0.5, 0.75, 1.0)
    """Shares of the frames that are seen, from the start."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Seeds of the networks."""
    recording_seed: int = 1
    """Seed of the new demonstrations; those of the shipped banks have 0."""

    def __post_init__(self) -> None:
        check_seeds(self.seeds)
        if min(self.draws, self.per_task) < 1:
            raise ValueError("--draws and --per-task must be at least 1")
        if not self.shares or min(self.shares) <= 0 or max(self.shares) > 1:
            raise ValueError("--shares must be above 0 and at most 1")


@dataclass(frozen=True)
class Networks:
    """GWR-B and groups of all seeds, grown from demonstrations of a bank."""

    gwr: GWRB
    groups: list[BehaviorGroups]
    bank: DemonstrationBank

    @classmethod
    def grow(cls, bank: DemonstrationBank, seeds: tuple[int, ...], draws: int) -> Networks:
        """Show each network training demonstrations, drawn uniformly."""
        config, size = BGPOConfig(), bank.embedding.shape[-1]
        batch = [len(seeds)]
        gwr = GWRB(size, config.gwr, batch_size=batch, generator=generators(seeds, "gwr"))
        groups = [
            BehaviorGroups(size, smallest=config.group_size, evidence=config.group_evidence)
            for _ in seeds
        ]
        draw = [np.random.default_rng(stream_seed(seed, "demonstrations")) for seed in seeds]
        shown = np.stack([rng.integers(len(bank.task), size=draws) for rng in draw])
        for rows in torch.from_numpy(shown).T:
            gwr.adapt(bank.embedding[rows])
            for of_seed, phi in zip(groups, bank.embedding[rows], strict=True):
                of_seed.adapt(phi)
        return cls(gwr, groups, bank)

    def grouped(self, phi: Tensor) -> tuple[Tensor, Tensor]:
        """Return groups and novelties ``[S, N]`` of demonstrations ``[N, 32]``."""
        matches = [groups.lookup(phi) for groups in self.groups]
        return torch.stack([m.group for m in matches]), torch.stack([m.novelty for m in matches])

    def right(self, node: Tensor, known: Tensor, task: Tensor) -> Tensor:
        """Return where a node or group of demonstrations is one of their task, bool ``[S, N]``.

        A node or group is of the task of which it holds the largest share of the bank.

        Args:
            node: Node or group of the demonstrations, int64 ``[S, N]``.
            known: The same of the bank's, ``[S, M]``.
            task: Tasks of the demonstrations, ``[N]``.
        """
        right = []
        for own, of_bank in zip(node, known, strict=True):
            majority = majority_task(group_counts(of_bank, self.bank.task))
            is_held = own < len(majority)
            right.append(is_held & (majority[own.where(is_held, 0)] == task))
        return torch.stack(right)


def known_tasks(
    networks: Networks, phi: Tensor, task: Tensor, seeds: tuple[int, ...]
) -> pd.DataFrame:
    """Return a row of each seed and task for demonstrations ``[N, 32]``."""
    gwr, seen = networks.gwr, networks.bank.embedding
    shown, of_bank = (e.expand(len(seeds), *e.shape) for e in (phi, seen))
    match, (group, novelty) = gwr.lookup(shown), networks.grouped(phi)
    columns = {
        "node_right": networks.right(match.node, gwr.lookup(of_bank).node, task).double(),
        "activity": match.activity.double(),
        "group_right": networks.right(group, networks.grouped(seen)[0], task).double(),
        "of_no_group": (novelty > 1).double(),
    }
    rows = [
        {"seed": seed, "task": name}
        | {key: float(values[index, task == label].mean()) for key, values in columns.items()}
        for index, seed in enumerate(seeds)
        for label, name in enumerate(networks.bank.tasks)
    ]
    return pd.DataFrame(rows)


def unknown_task(
    networks: Networks, known: Tensor, unknown: Tensor, seeds: tuple[int, ...]
) -> pd.DataFrame:
    """Return a row of each seed: how novelty tells an unknown task from the known ones."""
    novelty = [networks.grouped(phi)[1] for phi in (known, unknown)]
    rows = []
    for seed, ours, theirs in zip(seeds, *novelty, strict=True):
        wins = stats.mannwhitneyu(theirs, ours).statistic
        rows.append(
            {
                "seed": seed,
                "area": wins / (len(ours) * len(theirs)),
                "detected": float((theirs > 1).float().mean()),
                "false_alarms": float((ours > 1).float().mean()),
            }
        )
    return pd.DataFrame(rows)


@torch.no_grad()
def study(arguments: Arguments) -> str:
    """Measure both; write the files and return the tables."""
    torch.set_num_threads(1)
    seeds, tasks = arguments.seeds, chosen_tasks(arguments.tasks, NICO)
    if len(tasks) < 2:
        raise ValueError("--tasks: name at least two, of which each is left out in turn")
    encoders, bank = load_pretrained(tasks=tasks)
    out = make_folder(arguments.out)
    seen = bank.for_tasks(tasks).seen()
    new = new_demonstrations(
        tasks=tasks, per_task=arguments.per_task, seed=arguments.recording_seed
    )
    latent, length, task = encode_frames(encoders.frame_network, new), new["length"], new["task"]
    embedded = {
        share: encoders.lae.encode(latent, length.mul(share).round().long().clamp(min=1))
        for share in arguments.shares
    }
    networks = Networks.grow(seen, seeds, arguments.draws)
    known = pd.concat(
        known_tasks(networks, phi, task, seeds).assign(share=share)
        for share, phi in embedded.items()
    )
    parts = []
    for label, name in enumerate(tasks):
        without = Networks.grow(
            seen.for_tasks([other for other in tasks if other != name]), seeds, arguments.draws
        )
        for share, phi in embedded.items():
            found = unknown_task(without, phi[task != label], phi[task == label], seeds)
            parts.append(found.assign(left_out=name, share=share))
    unknown = pd.concat(parts)
    write_table(out / "known.csv", known.round(4))
    write_table(out / "unknown.csv", unknown.round(4))
    return f"{_table(known, 'task')}\n\n{_table(unknown, 'left_out')}"


def _table(rows: pd.DataFrame, by: str) -> str:
    """Return means over seeds of each share and task, and over all tasks."""
    measures = [str(name) for name in rows if name not in ("seed", "share", by)]
    table: Table = [[by, "seen", *measures]]
    for name, part in [("all", rows), *rows.groupby(by, sort=False)]:
        for share, of_share in part.groupby("share"):
            means = of_share[measures].mean()
            table.append([str(name), f"{share:.0%}", *(f"{means[m]:.3f}" for m in measures)])
    return markdown(table)


if __name__ == "__main__":
    command_line(study)
