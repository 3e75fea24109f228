"""Training of the encoders on recordings, from the recordings to the bank."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch
from tensordict import TensorDictBase

from bgpo_trl.configs import RepresentationConfig
from bgpo_trl.data.bank import DemonstrationBank, DemonstrationSteps
from bgpo_trl.data.dataset import check_scene
from bgpo_trl.data.recording import record_demonstrations
from bgpo_trl.encoders.fitting import Log, retrain_inverse, train_representation
from bgpo_trl.encoders.imitation import choose_noise
from bgpo_trl.encoders.mismatch import mismatch
from bgpo_trl.encoders.pretrained import bank_path
from bgpo_trl.encoders.probes import complaints, judged, probe
from bgpo_trl.encoders.representation import (
    Representation,
    encode_frames,
    part,
    save_representation,
    split,
)
from bgpo_trl.files.csv_file import CsvFile
from bgpo_trl.files.writing import check_folder, lock_directory
from bgpo_trl.scenes import Scene, find_scene

_TERMS = ("reconstruction", "kl", "inverse")
_COLUMNS = ("stage", "step", "learning_rate", *(f"loss_{term}" for term in _TERMS), *_TERMS)


def train_encoders(
    dataset: TensorDictBase,
    play: TensorDictBase | None,
    weights: Path,
    folder: Path,
    config: RepresentationConfig,
    *,
    tasks: Sequence[str],
    scene: Scene | str,
    command: str = "",
    device: torch.device | str = "cpu",
    progress: bool = True,
    spread: float = 1.0,
    keep: Representation | None = None,
) -> tuple[Representation, DemonstrationBank]:
    """Train, save and probe both encoders, and embed the demonstrations with them.

    Warns of what `complaints` finds.

    Args:
        dataset: Demonstrations as in `bgpo_trl.encoders.representation`, with ``state`` and
            ``task``.
        play: Recorded play in the same form, or ``None``.
        weights: Safetensors file to write; the bank is written beside it, see `bank_path`.
        folder: Folder for ``train.csv``, ``checkpoint/``, ``probes.json`` and
            ``reconstructions.png``.
        config: Hyperparameters.
        tasks: Task names, in the order of their labels.
        scene: The robot, or its name.
        command: Command line, stored with the weights.
        device: Device to train on.
        progress: Whether to show progress bars.
        spread: Share of the range of start states of the recordings.
        keep: Encoders of which only the inverse model is trained anew, on play.

    Raises:
        ValueError: As `train_representation`; if there are encoders to keep, but no play; or if
            there is ground truth to probe held-out play with, and no such play.
        OSError: If a file cannot be written.
    """
    scene = find_scene(scene)
    if config.inverse.largest_action is None:
        inverse = replace(config.inverse, largest_action=scene.largest_action)
        config = replace(config, inverse=inverse)
    if keep is None:
        if play is not None and scene.state is not None and "state" in play:
            part(play, "the recorded play", held_out=True)  # probed after hours of training
        parts = {"play": play, "scene": scene.identity, "spread": spread}
        fit = partial(train_representation, dataset, config, **parts)
    elif play is None:
        raise ValueError("to train the inverse model alone, give the folder of recorded play")
    else:
        split(dataset)  # probed after the training
        fit = partial(retrain_inverse, keep, play, config, shown=dataset)
    check_folder(weights.parent)  # before hours of training
    with lock_directory(folder), CsvFile(folder / "train.csv", _COLUMNS) as file:
        representation = fit(
            command=command,
            checkpoint=folder / "checkpoint",
            log=_log_of(file),
            progress=progress,
            device=device,
        )
    save_representation(representation, weights)
    made = {"tasks": tasks, "actions": scene.bank_actions, "spread": spread}
    # Without play, the inverse model has learned from these very actions.
    bank = make_bank(representation, dataset, **made, compare=play is not None)
    bank.save(bank_path(weights))
    play = None if keep else play
    found = probe(representation, dataset, folder, play=play, columns=scene.state)
    for complaint in complaints(judged(found, scene)):
        warnings.warn(f"{complaint} ({folder})", stacklevel=2)
    return representation, bank


@torch.no_grad()
def make_bank(
    representation: Representation,
    dataset: TensorDictBase,
    *,
    tasks: Sequence[str],
    actions: Literal["inferred", "recorded"] = "recorded",
    spread: float = 1.0,
    compare: bool = True,
) -> DemonstrationBank:
    """Embed demonstrations; keep latents, actions and joints of the training ones.

    The noise for imitation is chosen by `choose_noise`, within some seconds for each task.

    Args:
        representation: The trained encoders.
        dataset: Reads ``pixels`` ``[N, T, H, W, 3]``, ``length``, ``task`` and ``train`` ``[N]``,
            and, if they are there, ``action`` ``[N, T - 1, A]`` and ``joints`` ``[N, T, J]``.
        tasks: Task names, in the order of their labels.
        actions: ``"recorded"`` stores the actions of the dataset, or if it has none those that
            the inverse model infers from the frames; ``"inferred"`` always the latter, the only
            actions that an observer of a demonstration has. Without either, the bank has no steps:
            embeddings alone, without demonstrations as experience.
        spread: Share of the range of start states that the dataset was recorded over.
        compare: Whether to warn of what `mismatch` finds, as for other data than the encoders' own.

    Raises:
        ValueError: If the dataset shows another scene than the encoders.
    """
    check_scene(representation.metadata.get("scene"), dataset)
    length = dataset["length"]
    latent = encode_frames(representation.frame_network, dataset)
    inverse = representation.inverse
    inferred = None if inverse is None else inverse(latent, length)
    embedding = representation.lae.encode(latent, length)
    if compare and (doubt := mismatch(representation.frame_network, dataset, inferred, embedding)):
        warnings.warn(doubt, stacklevel=3)  # of the call before no_grad's
    action = dataset.get("action", None)
    if actions == "inferred" or action is None:
        action = inferred
    train, joints = dataset["train"].clone(), dataset.get("joints", None)
    bank = DemonstrationBank(
        embedding,
        dataset["task"].clone(),
        train,
        tuple(tasks),
        None if action is None else DemonstrationSteps.of(latent, action, length * train, joints),
        representation.identity,
        spread,
        representation.metadata.get("scene"),
    )
    noise = choose_noise(bank)
    return bank if noise is None else replace(bank, noise=noise)


def make_pretrained(
    weights: str | Path,
    dataset: str | Path,
    *,
    folder: str | Path,
    config: RepresentationConfig | None = None,
    per_task: int = 1_200,
    held_out_per_task: int = 200,
    seed: int = 0,
    tasks: Sequence[str] | None = None,
    scene: Scene | str = "nico",
    command: str = "",
    device: torch.device | str = "cpu",
    **shared: Any,
) -> tuple[Representation, DemonstrationBank]:
    """Record demonstrations and play, train both encoders, and embed the demonstrations.

    Demonstrations are recorded into the folder ``dataset``, and half as many episodes of play into
    the folder of the same name plus ``-play``; each interrupted stage is resumed. Other arguments
    are as for `record_demonstrations` and `train_encoders`, ``shared`` those of both.

    Raises:
        ValueError: If the dataset is damaged or was recorded in another scene.
    """
    scene = find_scene(scene)
    shared |= {"scene": scene, "tasks": scene.default_tasks if tasks is None else tuple(tasks)}
    record = partial(record_demonstrations, seed=seed, **shared)
    demonstrations = record(dataset, per_task=per_task, held_out_per_task=held_out_per_task)
    play = record(
        Path(dataset).with_name(f"{Path(dataset).name}-play"),
        per_task=max(2, per_task // 2),
        held_out_per_task=max(1, held_out_per_task // 4),
        play=True,
    )
    config, folder = config or RepresentationConfig(), Path(folder)
    options = {"command": command, "device": device, **shared}
    return train_encoders(demonstrations, play, Path(weights), folder, config, **options)


def _log_of(file: CsvFile) -> Log:
    """Return a log that replaces rows which an interrupted training wrote after its checkpoint."""

    def log(row: dict[str, Any]) -> None:
        again = file.path.read_bytes().find(f"\n{row['stage']},{row['step']},".encode())
        if again >= 0:
            file.truncate_to(again + 1)
        file.write(row)

    return log
