"""Commands that make data: recordings, encoders, and banks of embedded demonstrations."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tensordict import TensorDict

from bgpo_trl.data.dataset import load_demonstrations, read_meta
from bgpo_trl.data.recording import record_demonstrations
from bgpo_trl.encoders.pretrained import default_weights
from bgpo_trl.encoders.probes import probe, verdict_in
from bgpo_trl.encoders.representation import load_representation
from bgpo_trl.encoders.train import make_bank, train_encoders
from bgpo_trl.experiments.arguments import (
    EncodersArguments,
    MakeBankArguments,
    ProbesArguments,
    RecordArguments,
)
from bgpo_trl.experiments.settings import chosen_tasks
from bgpo_trl.files.tensor_file import load_tensors
from bgpo_trl.machine import choose_device
from bgpo_trl.runs.provenance import command
from bgpo_trl.scenes import find_scene


def record(arguments: RecordArguments) -> str:
    """Record demonstrations, or random play; see `record_demonstrations`."""
    options = {name: value for name, value in vars(arguments).items() if name != "module"}
    options["tasks"] = chosen_tasks(arguments.tasks, find_scene(arguments.scene))
    recorded = record_demonstrations(**options)
    what = "episodes of play" if arguments.play else "demonstrations"
    n_held_out = int((~recorded["train"]).sum())
    return f"{len(recorded)} {what}, {n_held_out} of them held out: {arguments.path}"


def encoders(arguments: EncodersArguments) -> str:
    """Train both encoders on recordings, and embed these; see `train_encoders`."""
    dataset, meta = _demonstrations(arguments.dataset)
    scene, keep = find_scene(meta["scene"]), arguments.keep
    train_encoders(
        dataset,
        arguments.play and load_demonstrations(arguments.play),
        arguments.weights or arguments.folder / "encoders.safetensors",
        arguments.folder,
        arguments.config,
        tasks=meta["tasks"],
        scene=scene,
        command=command(),
        device=choose_device(arguments.device),
        spread=meta["spread"],
        keep=None if keep is None else load_representation(keep, scene=scene),
    )
    return verdict_in(arguments.folder, scene)


def _demonstrations(path: Path) -> tuple[TensorDict, dict[str, Any]]:
    """Open demonstrations; return them and their settings."""
    meta = read_meta(path)
    if meta.get("play"):
        raise ValueError(
            f"{path} holds play, which is no demonstration: give the folder of demonstrations "
            "first, that of play second"
        )
    return load_demonstrations(path), meta


def bank(arguments: MakeBankArguments) -> str:
    """Embed a recorded dataset with trained encoders; see `make_bank`."""
    dataset, meta = _demonstrations(arguments.dataset)
    scene = find_scene(meta["scene"])
    weights = arguments.encoders or default_weights(scene=scene)
    if arguments.out.exists() and "embedding" not in load_tensors(arguments.out)[0]:
        raise ValueError(f"{arguments.out} is no bank, and is kept: name another file to write")
    made = make_bank(
        load_representation(weights, scene=scene),
        dataset,
        tasks=meta["tasks"],
        actions=arguments.actions or scene.bank_actions,
        spread=meta["spread"],
    )
    made.save(arguments.out)
    n_held_out = int((~made.train).sum())
    return f"{len(made.task)} demonstrations, {n_held_out} of them held out: {arguments.out}"


def probes(arguments: ProbesArguments) -> str:
    """Evaluate trained encoders with probes; see `probe`."""
    dataset, meta = _demonstrations(arguments.dataset)
    scene = find_scene(meta["scene"])
    weights = arguments.encoders or default_weights(meta["tasks"], scene=scene)
    representation = load_representation(weights, scene=scene)
    play = arguments.play and load_demonstrations(arguments.play)
    probe(representation, dataset, arguments.out, play=play, columns=scene.state)
    return verdict_in(arguments.out, scene)
