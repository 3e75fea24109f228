"""Continual World's ten tasks: what limits a clone of 30 demonstrations, and which groups form.

A clone of each task imitates its demonstrations, told the task, and is tested from 20 new starts.
It observes Meta-World's ground truth of 39 numbers, or the first 64 principal components of the
frames of all tasks, which take seconds instead of the VAE's hours. Groups form from embeddings of
sequences of these components.

    python -m benchmarks.studies.cw10_limits truth
    python -m benchmarks.studies.cw10_limits frames --folder runs/cw10/demonstrations
    python -m benchmarks.studies.cw10_limits groups --folder runs/cw10/demonstrations
    python -m benchmarks.studies.cw10_limits replay --folder runs/cw10/demonstrations

`replay` sees nothing: it repeats the actions of a demonstration of the task, from the new starts.

The folder is that of `benchmarks/continual_world.py`; demonstrations are recorded if missing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import tyro
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from bgpo_trl.analysis.task_inference import group_purity
from bgpo_trl.configs import BGPOConfig
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.data.recording import record_demonstrations
from bgpo_trl.encoders.representation import valid_frames, valid_steps
from bgpo_trl.experiments.command_line import command_line
from bgpo_trl.experiments.groups import draw, form
from bgpo_trl.experiments.settings import even_starts
from bgpo_trl.modules.sequence_autoencoder import SequenceAutoencoder
from bgpo_trl.objectives.supervised import sequence_reconstruction_loss
from bgpo_trl.transforms import TaskSchedule
from examples.continual_world import CW10, ContinualWorld
from examples.meta_world import demonstrator

SHOWN, HELD_OUT, TESTS, MAX_STEPS = 30, 10, 20, 50
COMPONENTS, NOISE, LIMIT, LEAST = 64, 0.2, 5.0, 0.1
DRAWS, SEEDS = 600, (0, 1, 2)

Act = Callable[[ContinualWorld], np.ndarray]


def perform(
    simulation: ContinualWorld, act: Callable[[], np.ndarray]
) -> tuple[list[Tensor], list[np.ndarray], bool]:
    """Act to the end of an episode; return ground truth and actions, and whether it succeeded."""
    seen, actions = [], []
    for _ in range(MAX_STEPS):
        seen.append(truth(simulation))
        actions.append(act())
        if simulation.step(actions[-1]).success:
            return seen, actions, True
    return seen, actions, False


def truth(simulation: ContinualWorld) -> Tensor:
    """Return Meta-World's ground truth, ``[39]``."""
    return torch.tensor(simulation.observation).float()


def demonstrate(task: str) -> tuple[Tensor, Tensor]:
    """Repeat the demonstrations of a recording; return ground truth and actions of its steps."""
    simulation, seen, actions = ContinualWorld({}), [], []
    for row in range(SHOWN):
        sequence = np.random.SeedSequence([0, CW10.index(task) * (SHOWN + HELD_OUT) + row])
        success = False
        while not success:
            start, noise = (int(child.generate_state(1)[0]) for child in sequence.spawn(2))
            simulation.seed(start)
            simulation.reset(task)
            act = demonstrator(simulation, task, noise)
            states, done, success = perform(simulation, act)
        seen += states
        actions += done
    return torch.stack(seen), torch.from_numpy(np.array(actions)).float()


def components(dataset: TensorDictBase) -> Callable[[Tensor], Tensor]:
    """Return the map from frames uint8 ``[..., H, W, 3]`` to scaled components ``[..., 64]``."""
    shown = (valid_frames(dataset[dataset["train"]]).float() / 255).flatten(1)
    mean = shown.mean(0)
    torch.manual_seed(0)
    directions = torch.svd_lowrank(shown - mean, q=COMPONENTS, niter=3)[2]
    scale = ((shown - mean) @ directions).std(0)
    scale = scale.clamp_min(LEAST * scale.max())

    def encode(pixels: Tensor) -> Tensor:
        return ((pixels.float() / 255).flatten(-3) - mean) @ directions / scale

    return encode


def clone(seen: Tensor, actions: Tensor) -> nn.Sequential:
    """Train a policy on the observations and actions ``[N, ...]`` of demonstrations."""
    torch.manual_seed(0)
    size = seen.shape[-1]
    hidden = nn.Linear(size, 128), nn.ReLU(), nn.Linear(128, 128), nn.ReLU()
    policy = nn.Sequential(*hidden, nn.Linear(128, 4), nn.Tanh())
    optimizer = torch.optim.Adam(policy.parameters(), 1e-3)
    for _ in range(3_000):
        rows = torch.randint(len(seen), (128,))
        noisy = seen[rows] + NOISE * torch.randn(128, size)
        loss = (policy(noisy) - actions[rows]).square().sum(-1).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return policy.requires_grad_(False)


def success(task: str, acts: Sequence[Act]) -> float:
    """Return the share of new starts, one for each of ``acts``, from which these succeed."""
    simulation = ContinualWorld({})
    simulation.seed(12_345)
    won = 0
    for act in acts:
        simulation.reset(task)
        won += perform(simulation, partial(act, simulation))[2]
    return won / len(acts)


def clone_of_truth(task: str) -> float:
    """Return the success of a clone that observes the ground truth."""
    seen, actions = demonstrate(task)
    mean, scale = seen.mean(0), seen.std(0)
    scale = scale.clamp_min(LEAST * scale[scale > 0].median())
    policy = clone((seen - mean) / scale, actions)

    def act(simulation: ContinualWorld) -> np.ndarray:
        return policy((truth(simulation) - mean) / scale).double().numpy()

    return success(task, [act] * TESTS)


def clone_of_frames(
    task: str, dataset: TensorDictBase, encode: Callable[[Tensor], Tensor]
) -> float:
    """Return the success of a clone that observes frames."""
    rows = (dataset["task"] == CW10.index(task)) & dataset["train"]
    valid = valid_steps(dataset["length"] - 1, dataset["action"].shape[1])[rows]
    seen = encode(dataset["pixels"][rows][:, :-1][valid]).clamp(-LIMIT, LIMIT)
    policy = clone(seen, dataset["action"][rows][valid])

    def act(simulation: ContinualWorld) -> np.ndarray:
        latent = encode(torch.from_numpy(simulation.frame())).clamp(-LIMIT, LIMIT)
        return policy(latent).double().numpy()

    return success(task, [act] * TESTS)


def success_of_replay(task: str, dataset: TensorDictBase) -> float:
    """Return the success of the actions of demonstrations, a different one from each new start."""
    rows = (dataset["task"] == CW10.index(task)) & dataset["train"]
    turns = [iter(actions.numpy()) for actions in dataset["action"][rows][:TESTS].double()]
    return success(task, [lambda _, turn=turn: next(turn) for turn in turns])


def embed(dataset: TensorDictBase, encode: Callable[[Tensor], Tensor], seed: int) -> Tensor:
    """Return the embedding of each demonstration, ``[N, 32]``."""
    length, train = dataset["length"], dataset["train"]
    valid = valid_steps(length, dataset["pixels"].shape[1])
    latent = torch.where(valid[..., None], encode(dataset["pixels"]), 0.0)
    torch.manual_seed(seed)
    lae = SequenceAutoencoder(COMPONENTS)
    optimizer = torch.optim.Adam(lae.parameters(), 1e-3)
    sequences, lengths = latent[train], length[train]
    for _ in range(400):
        rows = torch.randint(len(sequences), (64,))
        batch = TensorDict({"latent": sequences[rows], "length": lengths[rows]}, [64])
        optimizer.zero_grad()
        sequence_reconstruction_loss(lae, batch)["loss_reconstruction"].backward()
        optimizer.step()
    with torch.no_grad():
        return lae.encode(latent, length)


def print_groups(dataset: TensorDictBase, encode: Callable[[Tensor], Tensor]) -> None:
    """Print groups and purity, by order of the tasks and seed of embedding and draws."""
    starts = even_starts(len(CW10), DRAWS)
    schedules = {
        "one after the other": TaskSchedule(starts),
        "the newest only": TaskSchedule(starts, cumulative=False),
        "from the start": TaskSchedule((0,) * len(CW10)),
    }
    for seed in SEEDS:
        embedding = embed(dataset, encode, seed)
        bank = DemonstrationBank(embedding, dataset["task"], dataset["train"], CW10)
        for order, schedule in schedules.items():
            rows = [*draw(bank.seen(), schedule, DRAWS, seed)]
            groups, _, _ = form(bank.seen(), rows, BGPOConfig())
            purity = 100 * group_purity(groups, bank.held_out())
            print(seed, order, len(groups.numbers), f"{purity:.0f} %", flush=True)


@dataclass(frozen=True)
class Arguments:
    """Choose what to measure of clones and groups, and on which tasks."""

    what: tyro.conf.Positional[Literal["truth", "frames", "groups", "replay"]]
    """Measure clones of the ground truth or of frames, groups, or the replay of actions."""
    folder: Path = Path("runs/cw10/demonstrations")
    """Folder of the demonstrations."""
    tasks: tuple[str, ...] = CW10
    """Tasks to clone."""


def main(arguments: Arguments) -> None:
    """Measure what limits clones and groups."""
    torch.set_num_threads(1)
    measure = clone_of_truth
    if arguments.what != "truth":
        recorded = record_demonstrations(
            arguments.folder, scene="cw10", per_task=SHOWN + HELD_OUT, held_out_per_task=HELD_OUT
        )
        dataset = recorded.clone()
        if arguments.what == "groups":
            return print_groups(dataset, components(dataset))
        measure = partial(success_of_replay, dataset=dataset)
        if arguments.what == "frames":
            measure = partial(clone_of_frames, dataset=dataset, encode=components(dataset))
    for task in arguments.tasks:
        print(task, measure(task), flush=True)


if __name__ == "__main__":
    command_line(main, line=__doc__)
