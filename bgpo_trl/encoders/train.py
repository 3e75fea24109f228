"""Train encoders on recordings: ``python -m bgpo_trl.encoders.train data/nico``."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from tensordict import TensorDictBase

from bgpo_trl.configs import RepresentationConfig
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.data.dataset import load_demonstrations, read_meta
from bgpo_trl.data.recording import record_demonstrations
from bgpo_trl.encoders.fitting import Log
from bgpo_trl.encoders.make_bank import make_bank
from bgpo_trl.encoders.pretrained import bank_path
from bgpo_trl.encoders.probes import probe
from bgpo_trl.encoders.representation import (
    Representation,
    load_representation,
    retrain_inverse,
    save_representation,
    train_representation,
)
from bgpo_trl.files.csv_file import CsvFile
from bgpo_trl.files.writing import check_folder, make_folder, without_folders
from bgpo_trl.machine import choose_device
from bgpo_trl.plugins import import_plugin
from bgpo_trl.scenes import Scene, find_scene

_COLUMNS = (
    "stage",
    "step",
    "learning_rate",
    "loss_reconstruction",
    "loss_kl",
    "loss_inverse",
    "reconstruction",
    "kl",
    "inverse",
)


@dataclass(frozen=True)
class Arguments:
    """Train both encoders on recorded demonstrations and play, then probe them."""

    dataset: tyro.conf.Positional[Path]
    """Folder of the recorded demonstrations."""
    play: tyro.conf.Positional[Path | None] = None
    """Folder of recorded play; without it, the frame encoder learns from demonstrations only."""
    module: Annotated[str | None, tyro.conf.arg(name="import")] = None
    """Module that adds the scene, imported first; here or installed."""
    weights: Path | None = None
    """File to write, with the bank beside it; by default encoders.safetensors in the folder."""
    keep: Path | None = None
    """Encoders to keep: only their inverse model is trained anew, on play."""
    folder: Path = Path("runs/encoders")
    """Folder for checkpoints, log and probes; the same folder resumes an interrupted training."""
    config: RepresentationConfig = field(default_factory=RepresentationConfig)
    """Hyperparameters."""
    device: str = "auto"
    """Device to train on: cpu, cuda, or auto for a GPU if there is one."""


def train_encoders(
    dataset: TensorDictBase,
    play: TensorDictBase | None,
    weights: Path,
    folder: Path,
    config: RepresentationConfig,
    command: str = "",
    device: torch.device | str = "cpu",
    progress: bool = True,
    tasks: Sequence[str] | None = None,
    spread: float = 1.0,
    keep: Representation | None = None,
    scene: Scene | str = "nico",
) -> tuple[Representation, DemonstrationBank]:
    """Train, save and probe both encoders, and embed the demonstrations with them.

    Args:
        dataset: Demonstrations as in `bgpo_trl.encoders.representation`, with ``state`` and
            ``task``.
        play: Recorded play in the same form, or ``None``.
        weights: Safetensors file to write; the bank is written beside it, see `bank_path`.
        folder: Folder for ``train.csv``, ``checkpoint/``, ``probes.json`` and
            ``reconstructions.png``.
        config: Hyperparameters.
        command: Command line, stored with the weights.
        device: Device to train on.
        progress: Whether to show progress bars.
        tasks: Task names, in the order of their labels; by default the scene's.
        spread: Share of the range of start states of the recordings.
        keep: Encoders of which only the inverse model is trained anew, on play.
        scene: The robot, or its name.

    Raises:
        ValueError: As `train_representation`; if there are encoders to keep, but no play.
        OSError: If a file cannot be written.
    """
    if keep is not None and play is None:
        raise ValueError("to train the inverse model alone, give the folder of recorded play")
    scene = find_scene(scene)
    tasks = scene.default_tasks if tasks is None else tasks
    if config.inverse.largest_action is None:
        inverse = replace(config.inverse, largest_action=scene.largest_action)
        config = replace(config, inverse=inverse)
    make_folder(folder)
    check_folder(weights.parent)  # before hours of training
    with CsvFile(folder / "train.csv", _COLUMNS) as file:
        fit = {
            "command": command,
            "checkpoint": folder / "checkpoint",
            "log": _log_of(file),
            "progress": progress,
            "device": device,
        }
        if keep is not None and play is not None:
            representation = retrain_inverse(keep, play, config, **fit)
        else:
            representation = train_representation(
                dataset, config, play=play, scene=scene.identity, spread=spread, **fit
            )
    save_representation(representation, weights)
    actions = scene.bank_actions
    bank = make_bank(representation, dataset, tasks=tasks, actions=actions, spread=spread)
    bank.save(bank_path(weights))
    play = None if keep else play
    probe(representation, dataset, folder, play=play, columns=scene.state)
    return representation, bank


def make_pretrained(
    weights: str | Path,
    dataset: str | Path,
    *,
    folder: str | Path,
    config: RepresentationConfig | None = None,
    per_task: int = 1_200,
    held_out_per_task: int = 200,
    seed: int = 0,
    progress: bool = True,
    tasks: Sequence[str] | None = None,
    spread: float = 1.0,
    scene: Scene | str = "nico",
    **options: Any,
) -> tuple[Representation, DemonstrationBank]:
    """Record demonstrations and play, train both encoders, and embed the demonstrations.

    Each interrupted stage is resumed.

    Args:
        weights: File to write the encoders to; the bank is written beside it.
        dataset: Folder of the demonstrations, recorded if missing. Half as many episodes of play go
            to the folder of the same name plus ``-play``.
        folder: Folder for the training log, checkpoints and probes.
        config: Hyperparameters of the encoders.
        per_task: Demonstrations of each task.
        held_out_per_task: How many of those are held out.
        seed: Seed of the recording.
        progress: Whether to show progress bars.
        tasks: Tasks to demonstrate; by default the scene's.
        spread: Share of the whole range of start states.
        scene: The robot, or its name.
        **options: Further arguments of `train_encoders`.

    Raises:
        ValueError: If the dataset is damaged or was recorded in another scene.
    """
    shared: dict[str, Any] = {
        "scene": scene,
        "tasks": tasks,
        "spread": spread,
        "progress": progress,
    }
    record = partial(record_demonstrations, seed=seed, **shared)
    demonstrations = record(dataset, per_task=per_task, held_out_per_task=held_out_per_task)
    play = record(
        Path(dataset).with_name(f"{Path(dataset).name}-play"),
        per_task=max(2, per_task // 2),
        held_out_per_task=max(1, held_out_per_task // 4),
        play=True,
    )
    return train_encoders(
        demonstrations,
        play,
        Path(weights),
        Path(folder),
        config or RepresentationConfig(),
        **shared,
        **options,
    )


def _log_of(file: CsvFile) -> Log:
    """Return a log that replaces rows which an interrupted training wrote after its checkpoint."""

    def log(row: dict[str, Any]) -> None:
        again = file.path.read_bytes().find(f"\n{row['stage']},{row['step']},".encode())
        if again >= 0:
            file.truncate_to(again + 1)
        file.write(row)

    return log


def main(arguments: Arguments) -> None:
    """Run the command line."""
    import_plugin(arguments.module)
    dataset, meta = load_demonstrations(arguments.dataset), read_meta(arguments.dataset)
    scene, weights = find_scene(meta["scene"]), arguments.weights
    play = None if arguments.play is None else load_demonstrations(arguments.play)
    line = shlex.join(["python", "-m", "bgpo_trl.encoders.train", *sys.argv[1:]])
    keep = None
    if arguments.keep is not None:
        keep = load_representation(arguments.keep, scene=scene)
    train_encoders(
        dataset,
        play,
        arguments.folder / "encoders.safetensors" if weights is None else weights,
        arguments.folder,
        arguments.config,
        without_folders(line),
        choose_device(arguments.device),
        tasks=meta["tasks"],
        spread=meta["spread"],
        keep=keep,
        scene=scene,
    )


if __name__ == "__main__":
    try:
        main(tyro.cli(Arguments, description=Arguments.__doc__))
    except (ValueError, OSError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit("interrupted: the same command continues the training")
