"""Probes of the latents and of the embeddings, on held-out demonstrations.

Policies observe only latents and behaviors, so information that these lack cannot be learned
later. Every probe is fitted on training demonstrations and evaluated on held-out ones. No other
part of the encoders' training reads the ground-truth ``state``.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib.image
import numpy as np
import torch
from scipy import ndimage
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.modules import MLP

from bgpo_trl.data.dataset import check_scene
from bgpo_trl.encoders.representation import (
    Representation,
    encode_frames,
    initialized,
    mean_frame,
    split,
    valid_frames,
    valid_steps,
)
from bgpo_trl.files.writing import write_json, write_whole
from bgpo_trl.modules.frame_network import FrameNetwork
from bgpo_trl.modules.inverse_model import InverseModel
from bgpo_trl.modules.sequence_autoencoder import SequenceAutoencoder
from bgpo_trl.modules.vae import VAE
from bgpo_trl.objectives.supervised import sequence_reconstruction_loss
from bgpo_trl.scenes import Scene, StateColumns

OWN_TASK = 0.9
"""Least share of demonstrations that are nearest to one of their own task."""
_SEARCHED = 300  # frames in which things are looked for
_STANDS_OUT, _THING = 0.15, 4  # deviation of a pixel in the range of colors; least pixels


def probe(
    representation: Representation,
    dataset: TensorDictBase,
    folder: str | Path | None = None,
    *,
    play: TensorDictBase | None = None,
    columns: StateColumns | None = None,
) -> dict[str, float]:
    """Evaluate trained encoders.

    Args:
        representation: The trained encoders.
        dataset: Demonstrations that they were trained on, with their held-out part; reads
            ``pixels``, ``length``, ``train``, ``task`` and, if they are there, ``action`` and
            ``state``.
        folder: Folder for ``probes.json`` and, of the VAE, ``reconstructions.png``; ``None`` writes
            nothing.
        play: Recorded play in the form of the dataset; adds the errors of joints and objects, as
            ``play_...``, in frames that ``columns.valid`` accepts.
        columns: Meaning of ``state``; without either, joints and objects are left out.

    Returns:
        A flat dict: ``joint_<name>_rmse_rad`` (linear probe of one latent),
        ``<object>_error_cm`` and ``<object>_linear_error_cm`` (distance of a perceptron's and of a
        linear probe's place from the true one, mean over frames), ``inverse_rmse``, ``inverse_r2``
        and ``inverse_r2_<component>`` (actions of the training demonstrations, as they are inferred
        for the bank; components have the names of the joints if there are as many),
        ``sequence_mse`` (of standardized latents, so 1 is the level of predicting the mean),
        ``task_accuracy_linear``, ``task_accuracy_nearest``, ``task_accuracy_chance`` and
        ``active_dimensions``. Of the VAE also ``reconstruction`` (squared error per frame),
        ``mean_frame_reconstruction`` (the same for the mean training frame, the level of an
        untrained VAE), ``moving_reconstruction`` (share of the squared deviation from the mean
        frame that is reconstructed, of pixels that deviate by a tenth of the range or more) and
        ``things_lost``: share of connected regions that stand out from the mean frame, however
        small, of whose deviation less than a half is reconstructed.

    Raises:
        ValueError: If the dataset has no training or no held-out demonstrations, or it or play show
            another scene than the encoders.
    """
    check_scene(representation.metadata.get("scene"), dataset, play)
    network, lae = representation.frame_network, representation.lae
    train, held_out = _encoded(network, dataset)
    result = _probe_state(columns, train, held_out)
    result |= _probe_inverse(representation.inverse, train, columns)
    if isinstance(network, VAE):
        result |= _probe_reconstruction(network, train.data, held_out.data)
    sequences = TensorDict({"latent": held_out.latent, "length": held_out.length})
    error = sequence_reconstruction_loss(lae, sequences)["loss_reconstruction"]
    result["sequence_mse"] = error.item()
    spread = (train.latent * network.latent_std)[train.valid].std(0)
    result["active_dimensions"] = float((spread > 0.1 * spread.max()).sum())
    result |= _probe_tasks(lae, train, held_out)
    if play is not None and columns is not None and "state" in play:
        parts = _encoded(network, play, "the recorded play")
        errors = _probe_state(columns, *parts, only=columns.valid)
        result |= {f"play_{name}": error for name, error in errors.items()}
    if folder is not None:
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / "probes.json", result)
        if isinstance(network, VAE):
            picture, content = reconstruction_picture(network, held_out.data), io.BytesIO()
            matplotlib.image.imsave(content, picture.numpy(), format="png")
            write_whole(folder / "reconstructions.png", content.getvalue())
    return result


class _Encoded(NamedTuple):
    """Episodes with the latents of their frames ``[N, T, F]``, and which of these are valid."""

    data: TensorDictBase
    latent: Tensor
    valid: Tensor

    @property
    def length(self) -> Tensor:
        return self.data.get("length")


def _encoded(network: FrameNetwork, dataset: TensorDictBase, *name: str) -> list[_Encoded]:
    """Return the training and the held-out episodes of a dataset."""
    parts = []
    for data in split(dataset, *name):
        latent = encode_frames(network, data)
        parts.append(_Encoded(data, latent, valid_steps(data.get("length"), latent.shape[1])))
    return parts


class _Check(NamedTuple):
    """A result of `probe` that says whether encoders are good.

    Attributes:
        key: Of the result.
        name: Of the row in the `verdict`.
        bound: Least good value or, of a share of errors, the largest.
        complaint: What to do if it is not good, a format of all results.
        of_errors: Whether smaller values are better.
    """

    key: str
    name: str
    bound: float
    complaint: str
    of_errors: bool = False

    def passes(self, result: Mapping[str, float]) -> bool:
        value = result[self.key]
        return value <= self.bound if self.of_errors else value >= self.bound


_CHECKS = (
    _Check(
        "moving_reconstruction",
        "what moves in frames and is reconstructed",
        0.5,
        "encoders reconstruct {moving_reconstruction:.0%} of what moves in frames: look for the "
        "objects in reconstructions.png; train longer (vae.steps), lower vae.kl_weight, or show "
        "them larger",
    ),
    _Check(
        "things_lost",
        "things in frames that are not reconstructed",
        0.1,
        "{things_lost:.0%} of the things that stand out in frames are not reconstructed, so "
        "policies will not see them: look for them in reconstructions.png; train longer "
        "(vae.steps), lower vae.kl_weight, or show them larger",
        of_errors=True,
    ),
    _Check(
        "task_accuracy_nearest",
        "nearest demonstration is of the same task",
        OWN_TASK,
        "{task_accuracy_nearest:.0%} of the held-out demonstrations are nearest to one of their "
        "own task, {task_accuracy_chance:.0%} by chance: groups of behaviors will mix tasks; show "
        "objects larger, train longer (vae.steps, lae.steps), or record more demonstrations, or "
        "play",
    ),
    _Check(
        "inverse_r2",
        "inferred actions, R2",
        0.5,
        "actions inferred from frames have an R2 of {inverse_r2:.2f}: record more play, train "
        "longer (inverse.steps), or use recorded actions (bank_actions)",
    ),
)


def judged(result: Mapping[str, float], scene: Scene) -> dict[str, float]:
    """Return the results of `probe` that encoders of a scene are judged by.

    Inferred actions are good for nothing else than banks, and left out if these have recorded ones.
    """
    unused = {"inverse_r2"} if scene.bank_actions == "recorded" else set[str]()
    return {key: value for key, value in result.items() if key not in unused}


def complaints(result: Mapping[str, float]) -> list[str]:
    """Return what is not good in a result of `probe`, a line each with what to do.

    Examples:
        >>> good = {"task_accuracy_nearest": 0.97, "task_accuracy_chance": 0.5}
        >>> complaints({**good, "moving_reconstruction": 0.9, "inverse_r2": 0.8})
        []
        >>> for line in complaints({**good, "moving_reconstruction": 0.31}):
        ...     print(line)
        encoders reconstruct 31 % of what moves in frames: look for the objects in
        reconstructions.png; train longer (vae.steps), lower vae.kl_weight, or show them larger
    """
    wrong = [check for check in _CHECKS if check.key in result and not check.passes(result)]
    return [check.complaint.format(**result).replace("%", " %") for check in wrong]


def verdict(result: Mapping[str, float]) -> str:
    """Return a table of what `complaints` judges in a result of `probe`.

    Examples:
        >>> print(verdict({"task_accuracy_nearest": 1.0, "things_lost": 0.2}))
        things in frames that are not reconstructed  0.20  at most 0.10   not good
        nearest demonstration is of the same task    1.00  at least 0.90  ok
    """
    lines = []
    for check in _CHECKS:
        if check.key in result:
            asked = f"at {'most' if check.of_errors else 'least'} {check.bound:.2f}"
            found = "ok" if check.passes(result) else "not good"
            lines.append(f"{check.name:<43}  {result[check.key]:.2f}  {asked:<13}  {found}")
    return "\n".join(lines)


def verdict_in(folder: Path, scene: Scene) -> str:
    """Return the `verdict` of what `probe` wrote into a folder, with the path of its picture."""
    result = json.loads((folder / "probes.json").read_text())
    picture = folder / "reconstructions.png"
    look = f"\nlook for every object in {picture}" if picture.exists() else ""
    return f"{verdict(judged(result, scene))}{look}"


def ridge_predict(x: Tensor, y: Tensor, x_new: Tensor, penalty: float = 1e-4) -> Tensor:
    """Predict ``y`` ``[M, k]`` for ``x_new`` ``[M, d]`` by ridge regression with intercept.

    It is fitted on ``x`` ``[N, d]``, standardized, and ``y`` ``[N, k]``; ``penalty`` is the L2
    penalty per row on the coefficients.
    """
    scale, center = torch.std_mean(x.double(), 0)
    scale = scale.clamp_min(1e-8)
    a, b = (x - center) / scale, (x_new - center) / scale
    offset = y.double().mean(0)
    gram = a.T @ a / len(a) + penalty * torch.eye(a.shape[1], dtype=a.dtype)
    weight = torch.linalg.solve(gram, a.T @ (y - offset) / len(a))
    return (b @ weight + offset).float()


def perceptron_predict(x: Tensor, y: Tensor, x_new: Tensor, steps: int = 6_000) -> Tensor:
    """Predict ``y`` ``[M, k]`` for ``x_new`` ``[M, d]`` by a perceptron with two hidden layers.

    Its layers have 256 units, as a policy's of the default size, so it reads what a policy could.
    It is fitted on ``x`` ``[N, d]`` and ``y`` ``[N, k]``, both standardized, by ``steps`` steps of
    AdamW on 256 rows.
    """
    generator = torch.Generator().manual_seed(0)
    (scale, center), (unit, offset) = torch.std_mean(x, 0), torch.std_mean(y, 0)
    scale, unit = scale.clamp_min(1e-6), unit.clamp_min(1e-6)
    sizes = (x.shape[1], y.shape[1])
    network = initialized(0, partial(MLP, *sizes, num_cells=[256, 256], activation_class=nn.ReLU))
    optimizer = torch.optim.AdamW(network.parameters(), lr=2e-3, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in range(steps):
        rows = torch.randint(len(x), (256,), generator=generator)
        error = network((x[rows] - center) / scale) - (y[rows] - offset) / unit
        optimizer.zero_grad()
        error.square().mean().backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        return network((x_new - center) / scale) * unit + offset


@torch.no_grad()
def reconstruction_picture(vae: VAE, demonstrations: TensorDictBase, columns: int = 12) -> Tensor:
    """Return original frames above their reconstructions, each pixel enlarged to 4 x 4.

    Frames are spread over demonstrations and time; the picture is uint8
    ``[2 * H * 4, columns * W * 4, 3]``.
    """
    share = torch.linspace(0, 1, columns)
    demonstration = (share * (len(demonstrations) - 1)).round().long()
    # The stride mixes early, middle and late frames.
    time = (share * 5 % 1) * (demonstrations.get("length")[demonstration] - 1)
    frames = demonstrations.get("pixels")[demonstration, time.round().long()]
    decoded = (vae.decode(vae.encode(frames)[0]) * 255).round().to(torch.uint8)
    rows = [torch.cat(list(images), 1) for images in (frames, decoded)]
    return torch.cat(rows).repeat_interleave(4, 0).repeat_interleave(4, 1)


def _probe_state(
    columns: StateColumns | None,
    train: _Encoded,
    held_out: _Encoded,
    only: Callable[[Tensor], Tensor] | None = None,
) -> dict[str, float]:
    """Return the errors of joints and objects, in frames that ``only`` accepts."""
    if columns is None or "state" not in train.data:
        return {}
    (x, state), (x_new, wanted) = (
        (part.latent[chosen], part.data.get("state")[chosen])
        for part in (train, held_out)
        for chosen in [part.valid if only is None else part.valid & only(part.data.get("state"))]
    )
    if not (len(x) and len(x_new)):
        return {}
    linear = ridge_predict(x, state, x_new) - wanted
    read = perceptron_predict(x, state, x_new) - wanted
    joints = {
        f"joint_{name}_rmse_rad": _mean(linear[:, i].square()) ** 0.5
        for name, i in columns.angles.items()
    }
    return joints | {
        f"{name}_{kind}_cm": 100 * _mean(error[:, list(place)].norm(dim=-1))
        for name, place in columns.places.items()
        for kind, error in (("error", read), ("linear_error", linear))
    }


def _probe_tasks(lae: SequenceAutoencoder, train: _Encoded, held_out: _Encoded) -> dict[str, float]:
    """Return the accuracies of inferring a held-out demonstration's task from its embedding.

    Chance is the share of the most frequent task.
    """
    phi, phi_new = (lae.encode(part.latent, part.length) for part in (train, held_out))
    task, wanted = train.data.get("task"), held_out.data.get("task")
    scores = ridge_predict(phi, torch.nn.functional.one_hot(task).float(), phi_new)
    return {
        "task_accuracy_linear": _mean(scores.argmax(-1) == wanted),
        "task_accuracy_nearest": _mean(task[torch.cdist(phi_new, phi).argmin(-1)] == wanted),
        "task_accuracy_chance": wanted.bincount().max().item() / len(wanted),
    }


@torch.no_grad()
def _probe_inverse(
    inverse: InverseModel | None, shown: _Encoded, columns: StateColumns | None
) -> dict[str, float]:
    """Return the errors of inferred actions."""
    if inverse is None or "action" not in shown.data:
        return {}
    action, moves = shown.data.get("action"), shown.valid[:, 1:]
    action, error = action[moves], (inverse(shown.latent, shown.length) - action)[moves]
    left, all_ = error.square().sum(0), (action - action.mean(0)).square().sum(0)
    names = [] if columns is None else list(columns.angles)
    if len(names) != len(left):
        names = list(range(len(left)))
    by_joint = zip(names, left.tolist(), all_.tolist(), strict=True)
    sums = {
        "": (left.sum().item(), all_.sum().item()),
        **{f"_{n}": parts for n, *parts in by_joint},
    }
    return {
        "inverse_rmse": _mean(error.square()) ** 0.5,
        # In an action that is constant, there is nothing to explain.
        **{f"inverse_r2{name}": 1 - rest / total for name, (rest, total) in sums.items() if total},
    }


@torch.no_grad()
def _probe_reconstruction(
    vae: VAE, train: TensorDictBase, held_out: TensorDictBase
) -> dict[str, float]:
    frames, frames_held_out = valid_frames(train), valid_frames(held_out)
    mean = mean_frame(frames)

    def errors(chunk: Tensor) -> Tensor:
        """Return errors of decoded and of mean frames, of all pixels and of those that deviate."""
        decoded = (chunk / 255 - vae.decode(vae.encode(chunk)[0])).square()
        constant = (chunk / 255 - mean).square()
        moving = constant >= 0.1**2
        parts = (decoded, constant, decoded * moving, constant * moving)
        return torch.stack([part.sum((-3, -2, -1)) for part in parts], -1)

    some = torch.linspace(0, len(frames_held_out) - 1, _SEARCHED).long().unique()
    searched = frames_held_out[some]
    decoded = torch.cat([vae.decode(vae.encode(chunk)[0]) for chunk in searched.split(64)])
    means = torch.cat([errors(chunk) for chunk in frames_held_out.split(64)]).double().mean(0)
    reconstruction, of_mean, left, deviation = means.tolist()
    return {
        "reconstruction": reconstruction,
        "mean_frame_reconstruction": of_mean,
        "moving_reconstruction": 1 - left / deviation if deviation else 1.0,
        "things_lost": share_lost(searched / 255, decoded, mean),
    }


def share_lost(frames: Tensor, decoded: Tensor, background: Tensor) -> float:
    """Return the share of the things in frames that are not in their reconstructions.

    A thing is a connected region of four pixels or more, each of which differs from the background
    by 0.15 or more (root mean square of the colors). It is lost if less than half of its squared
    difference is reconstructed. A large robot that is reconstructed well does not hide a small
    object that is not. 0 if nothing stands out.

    Args:
        frames: ``[N, H, W, 3]``, from 0 to 1.
        decoded: Their reconstructions.
        background: Frame without things, ``[H, W, 3]``, such as the mean frame.
    """
    apart = (frames - background).square().sum(-1)
    error = (frames - decoded).square().sum(-1)
    lost = []
    for picture, left in zip(apart.numpy(), error.numpy(), strict=True):
        things: Any = ndimage.label(picture >= 3 * _STANDS_OUT**2, np.ones((3, 3)))
        sizes, shown, missed = (
            ndimage.sum_labels(values, things[0], range(1, things[1] + 1))
            for values in (np.ones_like(picture), picture, left)
        )
        lost.append((missed > 0.5 * shown)[sizes >= _THING])
    found = np.concatenate(lost)
    return float(found.mean()) if len(found) else 0.0


def _mean(values: Tensor) -> float:
    return values.double().mean().item()
