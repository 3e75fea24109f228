"""Embed recorded demonstrations for a run with ``--bank``.

python -m bgpo_trl.encoders.make_bank data/own own_bank.safetensors
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import torch
import tyro
from tensordict import TensorDictBase

from bgpo_trl.data.bank import DemonstrationBank, DemonstrationSteps
from bgpo_trl.data.dataset import load_demonstrations, read_meta
from bgpo_trl.encoders.pretrained import default_weights
from bgpo_trl.encoders.representation import (
    Representation,
    encode_frames,
    load_representation,
)
from bgpo_trl.plugins import import_plugin
from bgpo_trl.scenes import find_scene


@torch.no_grad()
def make_bank(
    representation: Representation,
    dataset: TensorDictBase,
    *,
    tasks: Sequence[str],
    actions: Literal["inferred", "recorded"] = "recorded",
    spread: float = 1.0,
) -> DemonstrationBank:
    """Embed demonstrations; keep the latents and actions of the training ones.

    Args:
        representation: The trained encoders.
        dataset: Reads ``pixels`` ``[N, T, H, W, 3]``, ``length``, ``task`` and ``train`` ``[N]``,
            and ``action`` ``[N, T - 1, A]``.
        tasks: Task names, in the order of their labels.
        actions: ``"recorded"`` stores the actions of the dataset, or if it has none those that
            the inverse model infers from the frames; ``"inferred"`` always the latter, the only
            actions that an observer of a demonstration has. Without either, the bank has no steps:
            embeddings alone, without demonstrations as experience.
        spread: Share of the range of start states that the dataset was recorded over.
    """
    length = dataset["length"]
    latent = encode_frames(representation.vae, dataset)
    action = dataset.get("action", None)
    if actions == "inferred" or action is None:
        inverse = representation.inverse
        action = None if inverse is None else inverse(latent, length)
    train = dataset["train"].clone()
    return DemonstrationBank(
        representation.lae.encode(latent, length),
        dataset["task"].clone(),
        train,
        tuple(tasks),
        None if action is None else DemonstrationSteps.of(latent, action, length * train),
        representation.identity,
        spread,
        representation.metadata.get("scene"),
    )


def main(
    dataset: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    weights: Path | None = None,
    module: Annotated[str | None, tyro.conf.arg(name="import")] = None,
    actions: Literal["inferred", "recorded"] | None = None,
) -> None:
    """Embed a recorded dataset with trained encoders.

    Args:
        dataset: Folder of the recorded demonstrations.
        out: Bank to write.
        weights: Encoder weights; by default those that come with the scene.
        module: Module that adds the scene, imported first; here or installed.
        actions: Actions of the stored demonstrations, recorded or inferred from frames; by default
            as the scene says.
    """
    import_plugin(module)
    meta = read_meta(dataset)
    scene = find_scene(meta["scene"])
    weights = default_weights(scene=scene) if weights is None else weights
    encoders = load_representation(weights, scene=scene)
    bank = make_bank(
        encoders,
        load_demonstrations(dataset),
        tasks=meta["tasks"],
        actions=scene.bank_actions if actions is None else actions,
        spread=meta["spread"],
    )
    bank.save(out)


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except (ValueError, OSError) as error:
        sys.exit(f"error: {error}")
