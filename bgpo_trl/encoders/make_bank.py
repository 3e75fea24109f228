"""Embedding of recorded demonstrations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from tensordict import TensorDictBase

from bgpo_trl.data.bank import DemonstrationBank, DemonstrationSteps
from bgpo_trl.encoders.representation import Representation, encode_frames


@torch.no_grad()
def make_bank(
    representation: Representation,
    dataset: TensorDictBase,
    *,
    tasks: Sequence[str],
    actions: Literal["inferred", "recorded"] = "recorded",
    spread: float = 1.0,
) -> DemonstrationBank:
    """Embed demonstrations; keep latents, actions and joints of the training ones.

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
    """
    length = dataset["length"]
    latent = encode_frames(representation.frame_network, dataset)
    action = dataset.get("action", None)
    if actions == "inferred" or action is None:
        inverse = representation.inverse
        action = None if inverse is None else inverse(latent, length)
    train, joints = dataset["train"].clone(), dataset.get("joints", None)
    return DemonstrationBank(
        representation.lae.encode(latent, length),
        dataset["task"].clone(),
        train,
        tuple(tasks),
        None if action is None else DemonstrationSteps.of(latent, action, length * train, joints),
        representation.identity,
        spread,
        representation.metadata.get("scene"),
    )
