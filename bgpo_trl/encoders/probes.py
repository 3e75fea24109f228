"""Probes of the latents and of the embeddings, on held-out demonstrations.

    python -m bgpo_trl.encoders.probes data/nico data/nico-play-long

Policies observe only latents and behaviors, so information that these lack cannot be learned
later. Every probe is fitted on training demonstrations and evaluated on held-out ones. No other
part of the encoders' training reads the ground-truth ``state``.
"""

from __future__ import annotations

import io
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import matplotlib.image
import torch
import tyro
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from bgpo_trl.data.dataset import load_demonstrations, read_meta
from bgpo_trl.encoders.pretrained import default_weights
from bgpo_trl.encoders.representation import (
    Representation,
    encode_frames,
    load_representation,
    mean_frame,
    split,
    valid_frames,
    valid_steps,
)
from bgpo_trl.files.writing import write_json, write_whole
from bgpo_trl.modules.inverse_model import InverseModel
from bgpo_trl.modules.sequence_autoencoder import SequenceAutoencoder
from bgpo_trl.modules.vae import VAE
from bgpo_trl.objectives.supervised import SequenceReconstructionLoss
from bgpo_trl.plugins import import_plugin
from bgpo_trl.scenes import StateColumns, find_scene


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
        folder: Folder for ``probes.json`` and ``reconstructions.png``; ``None`` writes nothing.
        play: Recorded play in the form of the dataset; adds the errors of joints and objects, as
            ``play_...``, in frames that ``columns.valid`` accepts.
        columns: Meaning of ``state``; without either, joints and objects are left out.

    Returns:
        A flat dict: ``joint_<name>_rmse_rad`` (linear probe of one latent),
        ``<object>_error_cm`` and ``<object>_linear_error_cm`` (distance of a perceptron's and of a
        linear probe's place from the true one, mean over frames), ``inverse_rmse``, ``inverse_r2``
        and ``inverse_r2_<component>`` (actions of the training demonstrations, as they are inferred
        for the bank; components have the names of the joints if there are as many),
        ``reconstruction`` (squared error per frame), ``mean_frame_reconstruction`` (the same for
        the mean training frame, the level of an untrained VAE), ``sequence_mse`` (of standardized
        latents, so 1 is the level of predicting the mean), ``task_accuracy_linear``,
        ``task_accuracy_nearest`` and ``active_dimensions``.

    Raises:
        ValueError: If the dataset has no training or no held-out demonstrations.
    """
    vae, lae = representation.vae, representation.lae
    train, held_out = split(dataset)
    latent, latent_held_out = encode_frames(vae, train), encode_frames(vae, held_out)
    result = {
        **_probe_state(columns, latent, train, latent_held_out, held_out),
        **_probe_inverse(representation.inverse, latent, train, columns),
        **_probe_reconstruction(vae, train, held_out),
        **_probe_sequences(lae, latent_held_out, held_out),
    }
    spread = (latent * vae.latent_std)[valid_steps(train.get("length"), latent.shape[1])].std(0)
    result["active_dimensions"] = float((spread > 0.1 * spread.max()).sum())

    phi = lae.encode(latent, train.get("length"))
    phi_held_out = lae.encode(latent_held_out, held_out.get("length"))
    result |= _probe_tasks(phi, train.get("task"), phi_held_out, held_out.get("task"))
    if play is not None:
        result |= _probe_play(vae, play, columns)
    if folder is not None:
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / "probes.json", result)
        picture, content = reconstruction_picture(vae, held_out), io.BytesIO()
        matplotlib.image.imsave(content, picture.numpy(), format="png")
        write_whole(folder / "reconstructions.png", content.getvalue())
    return result


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
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network = torch.nn.Sequential(
            torch.nn.Linear(x.shape[1], 256),
            torch.nn.ReLU(),
            torch.nn.Linear(256, 256),
            torch.nn.ReLU(),
            torch.nn.Linear(256, y.shape[1]),
        )
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
    latent: Tensor,
    train: TensorDictBase,
    latent_held_out: Tensor,
    held_out: TensorDictBase,
    only: Callable[[Tensor], Tensor] | None = None,
) -> dict[str, float]:
    if columns is None or "state" not in train:
        return {}
    valid, valid_held_out = (
        valid_steps(part.get("length"), latent.shape[1]) for part in (train, held_out)
    )
    if only is not None:
        valid = valid & only(train.get("state"))
        valid_held_out = valid_held_out & only(held_out.get("state"))
    state, wanted = train.get("state")[valid], held_out.get("state")[valid_held_out]
    error = ridge_predict(latent[valid], state, latent_held_out[valid_held_out]) - wanted
    read = perceptron_predict(latent[valid], state, latent_held_out[valid_held_out]) - wanted
    joints = {
        f"joint_{name}_rmse_rad": _mean(error[:, i].square()) ** 0.5
        for name, i in columns.angles.items()
    }
    return joints | {
        f"{name}_{kind}_cm": 100 * _mean(of_kind[:, list(place)].norm(dim=-1))
        for name, place in columns.places.items()
        for kind, of_kind in (("error", read), ("linear_error", error))
    }


def _probe_play(vae: VAE, play: TensorDictBase, columns: StateColumns | None) -> dict[str, float]:
    if columns is None or "state" not in play:
        return {}
    train, held_out = split(play)
    latent, latent_held_out = encode_frames(vae, train), encode_frames(vae, held_out)
    errors = _probe_state(columns, latent, train, latent_held_out, held_out, only=columns.valid)
    return {f"play_{name}": error for name, error in errors.items()}


def _probe_tasks(
    phi: Tensor, task: Tensor, phi_held_out: Tensor, task_held_out: Tensor
) -> dict[str, float]:
    """Return the accuracies of inferring a held-out demonstration's task from its embedding."""
    scores = ridge_predict(phi, torch.nn.functional.one_hot(task).float(), phi_held_out)
    nearest = torch.cdist(phi_held_out, phi).argmin(-1)
    return {
        "task_accuracy_linear": _mean(scores.argmax(-1) == task_held_out),
        "task_accuracy_nearest": _mean(task[nearest] == task_held_out),
    }


@torch.no_grad()
def _probe_inverse(
    inverse: InverseModel | None,
    latent: Tensor,
    shown: TensorDictBase,
    columns: StateColumns | None,
) -> dict[str, float]:
    if inverse is None or "action" not in shown:
        return {}
    action = shown.get("action")
    valid = valid_steps(shown.get("length") - 1, action.shape[1])
    action = action[valid]
    error = inverse(latent, shown.get("length"))[valid] - action
    left, all_ = error.square().sum(0), (action - action.mean(0)).square().sum(0)
    names = list(range(action.shape[-1]))
    if columns is not None and len(columns.angles) == len(names):
        names = list(columns.angles)
    by_joint = zip(names, (1 - left / all_).tolist(), strict=True)
    return {
        "inverse_rmse": _mean(error.square()) ** 0.5,
        "inverse_r2": 1 - (left.sum() / all_.sum()).item(),
        **{f"inverse_r2_{name}": r2 for name, r2 in by_joint},
    }


@torch.no_grad()
def _probe_reconstruction(
    vae: VAE, train: TensorDictBase, held_out: TensorDictBase
) -> dict[str, float]:
    frames, frames_held_out = valid_frames(train), valid_frames(held_out)
    mean = mean_frame(frames)

    def error(chunk: Tensor, guess: Tensor) -> Tensor:
        return (chunk / 255 - guess).square().sum((-3, -2, -1))

    chunks = frames_held_out.split(64)
    decoded = [error(chunk, vae.decode(vae.encode(chunk)[0])) for chunk in chunks]
    constant = [error(chunk, mean) for chunk in chunks]
    return {
        "reconstruction": _mean(torch.cat(decoded)),
        "mean_frame_reconstruction": _mean(torch.cat(constant)),
    }


@torch.no_grad()
def _probe_sequences(
    lae: SequenceAutoencoder, latent: Tensor, held_out: TensorDictBase
) -> dict[str, float]:
    loss = SequenceReconstructionLoss(lae)
    data = TensorDict({"latent": latent, "length": held_out.get("length")}, [len(latent)])
    return {"sequence_mse": loss(data)["loss_reconstruction"].item()}


def _mean(values: Tensor) -> float:
    return values.double().mean().item()


@dataclass(frozen=True)
class Arguments:
    """Evaluate trained encoders with probes."""

    dataset: tyro.conf.Positional[Path]
    """Folder of the recorded demonstrations."""
    play: tyro.conf.Positional[Path | None] = None
    """Folder of recorded play."""
    module: Annotated[str | None, tyro.conf.arg(name="import")] = None
    """Module that adds the scene, imported first; here or installed."""
    weights: Path | None = None
    """Encoder weights; by default those of the scene for the dataset's tasks."""
    out: Path = Path("runs/probes")
    """Folder for probes.json and reconstructions.png."""


def main(arguments: Arguments) -> None:
    """Run the command line."""
    import_plugin(arguments.module)
    meta = read_meta(arguments.dataset)
    scene, weights = find_scene(meta["scene"]), arguments.weights
    if weights is None:
        weights = default_weights(meta["tasks"], scene=scene)
    representation = load_representation(weights, scene=scene)
    play = None if arguments.play is None else load_demonstrations(arguments.play)
    dataset = load_demonstrations(arguments.dataset)
    probe(representation, dataset, arguments.out, play=play, columns=scene.state)


if __name__ == "__main__":
    try:
        main(tyro.cli(Arguments, description=Arguments.__doc__))
    except (ValueError, OSError) as error:
        sys.exit(f"error: {error}")
