"""The two frozen encoders: what they make of demonstrations, and their file (Sec. III-A).

`bgpo_trl.encoders.fitting` trains them, `bgpo_trl.encoders.probes` evaluates them.

A dataset is a TensorDict ``[N]`` with ``pixels`` uint8 ``[N, T, H, W, 3]``, ``action``
``[N, T - 1, A]`` if actions are known, ``length`` int64 ``[N]`` (frames) and ``train`` bool
``[N]``.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from bgpo_trl.errors import check_fetched
from bgpo_trl.files.tensor_file import digest, load_tensors, save_tensors
from bgpo_trl.modules.frame_network import FrameNetwork, FrameNetworkError, make_frame_network
from bgpo_trl.modules.inverse_model import InverseModel
from bgpo_trl.modules.sequence_autoencoder import SequenceAutoencoder
from bgpo_trl.modules.vae import VAE
from bgpo_trl.scenes import Scene

Network = TypeVar("Network", bound=nn.Module)


@dataclass
class Representation:
    """The two trained encoders, the inverse model, and the metadata of their training.

    Attributes:
        frame_network: Frame encoder, the `VAE` or one's own; ``frame_network.latent(pixels)`` is
            the latent used downstream.
        lae: Sequence encoder; ``lae.encode(latent, length)`` is the embedding phi.
        inverse: Inverse model on latents; it infers the actions of demonstrations for a bank. None
            if it was trained on nothing: no recorded actions were known.
        metadata: ``scene`` (`Scene.identity`), ``spread``, ``config`` (JSON), ``seed`` and
            ``command``; of a frame network of one's own also ``frame_network``, its identity, and
            ``frame_shape`` (JSON).
    """

    frame_network: FrameNetwork
    lae: SequenceAutoencoder
    inverse: InverseModel | None
    metadata: dict[str, str]

    def networks(self) -> list[tuple[str, nn.Module]]:
        """Return the networks with the prefixes of their weights in files."""
        prefix = "vae." if self.frame_network.identity == VAE.identity else "frame_network."
        found = {prefix: self.frame_network, "lae.": self.lae, "inverse.": self.inverse}
        return [(prefix, network) for prefix, network in found.items() if network is not None]

    @property
    def identity(self) -> str:
        """Digest of all weights; it identifies the encoders that made an embedding.

        Of a frame network of one's own, also of its name and version, since another function may
        have the same weights.
        """
        weights, name = digest(_tensors(self)), self.frame_network.identity
        if name == VAE.identity:
            return weights
        return hashlib.sha256(f"{name} {weights}".encode()).hexdigest()

    def check_scene(self, scene: Scene, what: object, remedy: str) -> None:
        """Raise ``ValueError`` unless the encoders are of a scene, and of its frames' size.

        ``what`` and ``remedy`` are as for `Scene.check_identity`.
        """
        scene.check_identity(self.metadata.get("scene"), what, remedy)
        found, wanted = [*self.frame_network.frame_shape], [*scene.frame_shape]
        if self.inverse is not None:  # else, no actions were known
            found, wanted = [*found, self.inverse.action_size], [*wanted, scene.action_size]
        if found != wanted:
            raise ValueError(
                f"{what} has frames of {found[:2]} and {found[2:]} actions, the scene {wanted[:2]} "
                f"and {wanted[2:]}: {remedy}, and change the scene's version with its sizes"
            )


@torch.no_grad()
def encode_frames(network: FrameNetwork, dataset: TensorDictBase) -> Tensor:
    """Encode the valid frames of demonstrations, 64 at a time.

    Reads ``pixels`` uint8 ``[N, T, H, W, 3]`` and ``length`` ``[N]``.

    Returns:
        Standardized latents, float32 ``[N, T, latent_size]``; zeros at and beyond ``length``.
    """
    pixels, length = dataset.get("pixels"), dataset.get("length")
    latent = torch.zeros(*pixels.shape[:2], network.latent_size)
    device = network.latent_mean.device
    demonstration, time = valid_steps(length, pixels.shape[1]).nonzero(as_tuple=True)
    for d, t in zip(demonstration.split(64), time.split(64), strict=True):
        latent[d, t] = network.latent(pixels[d, t].to(device)).cpu()
    return latent


@torch.no_grad()
def embed_demonstrations(representation: Representation, dataset: TensorDictBase) -> Tensor:
    """Embed whole demonstrations as phi, float32 ``[N, embedding_size]`` (Alg. 1).

    Reads ``pixels`` ``[N, T, H, W, 3]`` and ``length`` ``[N]``.
    """
    latent = encode_frames(representation.frame_network, dataset)
    return representation.lae.encode(latent, dataset.get("length"))


def save_representation(representation: Representation, path: str | Path) -> None:
    """Write both encoders and the metadata to one safetensors file; missing folders are made.

    Raises:
        ValueError: As for `check_savable`.
        OSError: If the file cannot be written; an existing file is kept.
    """
    check_savable(representation)
    save_tensors(path, _tensors(representation), representation.metadata)


@torch.no_grad()
def check_savable(representation: Representation) -> None:
    """Raise ``ValueError`` if `load_representation` would not return the same encoders.

    It makes a frame network of the name, and the other networks of the sizes, in the metadata, and
    compares what all of them make of two frames of noise.
    """
    noise, shape = torch.Generator().manual_seed(0), representation.frame_network.frame_shape
    frames = torch.randint(256, (1, 2, *shape, 3), generator=noise, dtype=torch.uint8)
    data = TensorDict({"pixels": frames, "length": torch.tensor([2])}, [1])
    try:
        made = _of_tensors(_tensors(representation), representation.metadata)
        pairs = zip(_outputs(representation, data), _outputs(made, data), strict=True)
        same = all(torch.allclose(*pair, 1e-3, 1e-3) for pair in pairs)
        found = "" if same else "what they return depends on more than parameters and buffers"
    except Exception as error:
        found = " ".join(f"{type(error).__name__}: {error}".split())
    if found:
        raise ValueError(
            f"these encoders could be saved, but not loaded again ({found}): train them with "
            "bgpo_trl.encoders.train, a frame network of your own by its name in FRAME_NETWORKS"
        )


def _outputs(encoders: Representation, data: TensorDictBase) -> list[Tensor]:
    """Return latents, embeddings and, if they can be inferred, actions of episodes."""
    latent, length = encode_frames(encoders.frame_network, data), data.get("length")
    found = [latent, encoders.lae.encode(latent, length)]
    return found if encoders.inverse is None else [*found, encoders.inverse(latent, length)]


def load_representation(path: str | Path, *, scene: Scene | None = None) -> Representation:
    """Read encoders written by `save_representation`; they are in eval mode, without gradients.

    By default, those of any scene are accepted.

    Raises:
        ValueError: If the file is missing, damaged, or belongs to another scene, or no imported
            module has the version of its frame network.
    """
    path = Path(path)
    remedy = "train some with `bgpo encoders` or --train-encoders"
    check_fetched(path)
    try:
        tensors, metadata = load_tensors(path)
        encoders = _of_tensors(tensors, metadata)
    except FileNotFoundError:
        raise ValueError(f"no encoder weights at {path}: {remedy}") from None
    except FrameNetworkError as error:
        raise ValueError(f"{path} cannot be loaded: {error}") from None
    except Exception as error:
        raise ValueError(f"{path} is damaged or holds no encoder weights: {remedy}") from error
    if scene is not None:
        encoders.check_scene(scene, path, remedy)
    for _, module in encoders.networks():
        module.eval().requires_grad_(False)
    return encoders


def _of_tensors(tensors: Mapping[str, Tensor], metadata: dict[str, str]) -> Representation:
    """Return encoders of the tensors and metadata of a file."""
    config = json.loads(metadata["config"])
    if "frame_network" in metadata:
        identity, shape = metadata["frame_network"], json.loads(metadata["frame_shape"])
        network = initialized(0, make_frame_network, identity.partition(" ")[0], shape)
        if network.identity != identity:
            raise FrameNetworkError(
                f"it is of the frame network {identity!r}, the imported module has "
                f"{network.identity!r}: use the version of the module, or train new ones"
            )
    else:
        network = VAE(
            config["vae"]["latent_size"],
            len(tensors["vae.inverse_head.bias"]),
            tensors["vae.mean_frame"].shape[:2],
            config["vae"].get("keypoints", True),
        )
    lae = SequenceAutoencoder(network.latent_size, config["lae"]["embedding_size"])
    inverse = None
    if (last := tensors.get("inverse.network.4.bias")) is not None:
        inverse = InverseModel(network.latent_size, len(last), config["inverse"]["hidden_size"])
    encoders = Representation(network, lae, inverse, metadata)
    for name, module in encoders.networks():
        found = {k.removeprefix(name): v for k, v in tensors.items() if k.startswith(name)}
        # A value of another type would be converted.
        kinds = {key: value.dtype for key, value in module.state_dict().items()}
        if any(value.dtype != kinds.get(key) for key, value in found.items()):
            raise ValueError("weights are of other types than those of the networks")
        module.load_state_dict(found)
    return encoders


def _tensors(representation: Representation) -> dict[str, Tensor]:
    return {
        f"{prefix}{key}": value
        for prefix, network in representation.networks()
        for key, value in network.state_dict().items()
    }


def split(
    dataset: TensorDictBase, name: str = "the dataset"
) -> tuple[TensorDictBase, TensorDictBase]:
    """Return the training and the held-out episodes, see `part`."""
    held_out = part(dataset, name, held_out=True)
    return part(dataset, name), held_out


def part(dataset: TensorDictBase, name: str, *, held_out: bool = False) -> TensorDictBase:
    """Return the training or the held-out episodes, by the key ``train``; ``name`` is for errors.

    Raises:
        ValueError: If there are none.
    """
    chosen = dataset.get("train").bool() != held_out
    if not chosen.any():
        lacking = "held-out episodes" if held_out else "episodes to train on"
        bound = "of at least 1" if held_out else "below the number of episodes of each task"
        raise ValueError(
            f"{name} has no {lacking} (key 'train'): record or write it with a held_out_per_task "
            f"{bound}"
        )
    return dataset[chosen]  # pyright: ignore[reportReturnType]


def valid_steps(length: Tensor, steps: int) -> Tensor:
    """Return the mask of valid steps, bool ``[N, steps]``, for lengths ``[N]``."""
    return torch.arange(steps) < length.unsqueeze(-1)


def valid_frames(dataset: TensorDictBase) -> Tensor:
    """Return all valid frames, concatenated, uint8 ``[sum(length), H, W, 3]``."""
    pixels = dataset.get("pixels")
    return pixels[valid_steps(dataset.get("length"), pixels.shape[1])]


def mean_frame(frames: Tensor) -> Tensor:
    """Return the mean of uint8 ``[F, H, W, 3]`` as float32 ``[H, W, 3]`` in [0, 1]."""
    # In parts: a sum over all frames would first convert all of them to int64.
    parts = [part.sum(0, dtype=torch.int64) for part in frames.split(1024)]
    return torch.stack(parts).sum(0) / (255 * len(frames))


def initialized(seed: int, make: Callable[..., Network], *arguments: Any) -> Network:
    """Return a network with initial weights drawn from a seed, without use of global state."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return make(*arguments)
