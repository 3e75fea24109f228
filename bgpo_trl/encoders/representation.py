"""Train, save and load the two frozen encoders, and embed demonstrations (Sec. III-A).

`train_representation` first trains the VAE with its inverse model on the frames of
demonstrations and play, or takes a frame network of one's own (`FRAME_NETWORKS`). Then it trains
the LSTM autoencoder and the inverse model on the latents; `bgpo_trl.encoders.probes` evaluates the
result.

A dataset is a TensorDict ``[N]`` with ``pixels`` uint8 ``[N, T, H, W, 3]``, ``action``
``[N, T - 1, A]`` if actions are known, ``length`` int64 ``[N]`` (frames) and ``train`` bool
``[N]``.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from bgpo_trl.configs import (
    InverseModelConfig,
    RepresentationConfig,
    SequenceAutoencoderConfig,
    VAEConfig,
)
from bgpo_trl.encoders.fitting import Fit, Log
from bgpo_trl.files.tensor_file import digest, load_tensors, save_tensors
from bgpo_trl.modules.frame_network import (
    FrameNetwork,
    FrameNetworkError,
    make_frame_network,
)
from bgpo_trl.modules.inverse_model import InverseModel, window
from bgpo_trl.modules.sequence_autoencoder import SequenceAutoencoder
from bgpo_trl.modules.vae import VAE
from bgpo_trl.objectives.supervised import (
    ActionInferenceLoss,
    SequenceReconstructionLoss,
    VAEInverseLoss,
)
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

        Args:
            scene: The robot.
            what: Name of the encoders, such as their path, which begins the message.
            remedy: What to do if they are of another version of the scene.
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


def train_representation(
    dataset: TensorDictBase,
    config: RepresentationConfig | None = None,
    *,
    play: TensorDictBase | None = None,
    scene: str,
    spread: float = 1.0,
    command: str = "",
    checkpoint: str | Path | None = None,
    log: Log | None = None,
    progress: bool = True,
    device: torch.device | str = "cpu",
) -> Representation:
    """Train both encoders on the training demonstrations.

    A frame network of one's own (``config.frame_network``) is taken as it is, and only the scale of
    its latents is set.

    Args:
        dataset: Demonstrations in the form given by the module; held-out ones are not read.
        config: Hyperparameters; ``RepresentationConfig()`` by default.
        play: Episodes of play in the same form, which train the frame encoder on states that
            demonstrations never visit. The inverse model then learns from the actions of play
            alone, so that it has seen none of the actions that it infers for demonstrations;
            without play, it learns from those of demonstrations. If what it would learn from lacks
            actions, or it gets no steps, there is none.
        scene: Identity of the scene of the frames (`Scene.identity`), stored with the weights.
        spread: Share of the range of start states of the recordings, stored with the weights.
        command: Command line, stored with the weights.
        checkpoint: Folder for checkpoints, from which an interrupted training is resumed and then
            gives the same weights.
        log: Receives a row every ``config.log_every`` steps.
        progress: Whether to show a progress bar for each stage.
        device: Device to train on.

    Returns:
        The trained encoders, on the CPU, in eval mode, without gradients.

    Raises:
        ValueError: If the dataset or the configuration cannot be trained on, no imported module has
            the frame network, or ``checkpoint`` belongs to a training with another configuration;
            or if ``largest_action`` leaves no action to learn from, or more than a twentieth of
            those demonstrated out.
    """
    config = config or RepresentationConfig()
    train, _ = split(dataset)
    seen = [train] if play is None else [train, split(play, "the recorded play")[0]]
    own = seen[-1]
    _check_actions(train, own, config.inverse)
    folder = Path(checkpoint) if checkpoint else None
    fit = Fit(config, folder, log, progress, device)
    if config.frame_network == "vae":
        network = _train_vae(seen, config.vae, fit, config.seed)
    else:
        network = _take_frame_network(config.frame_network, seen, fit, config.seed)
        taken = f"{network.identity} {digest(network.state_dict())}"
        fit = replace(fit, frame_network=taken)
    latent = encode_frames(network, train)
    lae = _train_lae(latent, train.get("length"), config.lae, fit, config.seed)
    inverse = None
    if config.inverse.steps and "action" in own:
        if play is not None:
            latent = encode_frames(network, own)
        inverse = _train_inverse(latent, own, config.inverse, fit, config.seed).cpu()
    metadata = {
        "scene": scene,
        "spread": str(spread),
        "config": json.dumps(asdict(config)),
        "seed": str(config.seed),
        "command": command,
    }
    if network.identity != VAE.identity:
        shape = json.dumps(network.frame_shape)
        metadata |= {"frame_network": network.identity, "frame_shape": shape}
    return Representation(network.cpu(), lae.cpu(), inverse, metadata)


def retrain_inverse(
    representation: Representation,
    play: TensorDictBase,
    config: RepresentationConfig | None = None,
    *,
    command: str = "",
    checkpoint: str | Path | None = None,
    log: Log | None = None,
    progress: bool = True,
    device: torch.device | str = "cpu",
) -> Representation:
    """Train the inverse model of encoders anew, on the training part of ``play``; keep the rest.

    What limits the inverse model is the amount of play (docs/learning.md), which costs little to
    record, whereas the other encoders would take longer to train on it. Of ``config``, the seed,
    the intervals and ``inverse`` are used. Other arguments, the result and errors are as for
    `train_representation`; play without actions is refused, too.
    """
    config = config or RepresentationConfig()
    folder = Path(checkpoint) if checkpoint else None
    own, _ = split(play, "the recorded play")
    if "action" not in own:
        raise ValueError("the inverse model learns from actions, which this play lacks: record it")
    _check_actions(None, own, config.inverse)
    network = representation.frame_network.to(device)
    latent = encode_frames(network, own)
    fit = Fit(config, folder, log, progress, device)
    inverse = _train_inverse(latent, own, config.inverse, fit, config.seed)
    metadata = representation.metadata
    kept = {**json.loads(metadata["config"]), "inverse": asdict(config.inverse)}
    commands = "; ".join(part for part in (metadata["command"], command) if part)
    metadata = {**metadata, "config": json.dumps(kept), "command": commands}
    return Representation(network.cpu(), representation.lae, inverse.cpu(), metadata)


@torch.no_grad()
def encode_frames(network: FrameNetwork, dataset: TensorDictBase, batch_size: int = 64) -> Tensor:
    """Encode the valid frames of demonstrations in batches.

    Reads ``pixels`` uint8 ``[N, T, H, W, 3]`` and ``length`` ``[N]``.

    Returns:
        Standardized latents, float32 ``[N, T, latent_size]``; zeros at and beyond ``length``.
    """
    pixels, length = dataset.get("pixels"), dataset.get("length")
    latent = torch.zeros(*pixels.shape[:2], network.latent_size)
    device = network.latent_mean.device
    demonstration, time = valid_steps(length, pixels.shape[1]).nonzero(as_tuple=True)
    for d, t in zip(demonstration.split(batch_size), time.split(batch_size), strict=True):
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

    It makes a frame network of the name, and the other networks of the sizes, in the metadata.
    """
    network = representation.frame_network
    try:
        made = _of_tensors(_tensors(representation), representation.metadata)
    except Exception as error:
        cause = " ".join(f"{type(error).__name__}: {error}".split())
        made, found = None, f"others could not be made of their tensors and metadata ({cause})"
    else:
        kinds = [[type(network) for _, network in r.networks()] for r in (representation, made)]
        found = next((a.__qualname__ for a, b in zip(*kinds, strict=True) if a is not b), "")
        found = f"{found} is of a class of its own" if found else ""
        if not found and network.identity != VAE.identity:
            found = _difference(network, made.frame_network)
    if found:
        raise ValueError(
            f"these encoders could be saved, but not loaded again: {found}; train them with "
            "bgpo_trl.encoders.train, a frame network of your own by its name in FRAME_NETWORKS"
        )


def _difference(network: FrameNetwork, made: FrameNetwork) -> str:
    """Return why a network of the same class and weights is another one; "" if it is not."""
    if made.identity != network.identity:
        return f"{made.identity!r} would be made in place of {network.identity!r}"
    noise, device = torch.Generator().manual_seed(0), network.latent_mean.device
    shape = (2, *network.frame_shape, 3)
    frames = torch.randint(256, shape, generator=noise, dtype=torch.uint8).to(device)
    if torch.allclose(made.to(device).latent(frames), network.latent(frames), 1e-3, 1e-3):
        return ""
    return f"latents of {network.identity!r} depend on more than its parameters and buffers"


def load_representation(path: str | Path, *, scene: Scene | None = None) -> Representation:
    """Read encoders written by `save_representation`; they are in eval mode, without gradients.

    By default, those of any scene are accepted.

    Raises:
        ValueError: If the file is missing, damaged, or belongs to another scene, or no imported
            module has the version of its frame network.
    """
    path = Path(path)
    remedy = "train new ones with --train-encoders"
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
    action_size = None
    if any(name.startswith("inverse.") for name in tensors):
        action_size = len(tensors["inverse.network.4.bias"])
    if "frame_network" in metadata:
        network = _named_frame_network(metadata)
    else:
        network = VAE(
            config["vae"]["latent_size"],
            len(tensors["vae.inverse_head.bias"]),
            tensors["vae.mean_frame"].shape[:2],
            config["vae"].get("keypoints", True),
        )
    lae = SequenceAutoencoder(network.latent_size, config["lae"]["embedding_size"])
    inverse = None
    if action_size is not None:
        inverse = InverseModel(network.latent_size, action_size, config["inverse"]["hidden_size"])
    encoders = Representation(network, lae, inverse, metadata)
    for name, module in encoders.networks():
        found = {k.removeprefix(name): v for k, v in tensors.items() if k.startswith(name)}
        # A value of another type would be converted.
        kinds = {key: value.dtype for key, value in module.state_dict().items()}
        if any(value.dtype != kinds.get(key) for key, value in found.items()):
            raise ValueError("weights are of other types than those of the networks")
        module.load_state_dict(found)
    return encoders


def _named_frame_network(metadata: Mapping[str, str]) -> FrameNetwork:
    """Return the frame network of one's own that metadata name, with other weights."""
    identity, shape = metadata["frame_network"], json.loads(metadata["frame_shape"])
    network = _initialized(0, make_frame_network, identity.partition(" ")[0], shape)
    if network.identity != identity:
        raise FrameNetworkError(
            f"it is of the frame network {identity!r}, the imported module has "
            f"{network.identity!r}: use the version of the module, or train new ones"
        )
    return network


def _tensors(representation: Representation) -> dict[str, Tensor]:
    return {
        f"{prefix}{key}": value
        for prefix, network in representation.networks()
        for key, value in network.state_dict().items()
    }


def split(
    dataset: TensorDictBase, name: str = "the dataset"
) -> tuple[TensorDictBase, TensorDictBase]:
    """Return the training and the held-out episodes, by the key ``train``; ``name`` is for errors.

    Raises:
        ValueError: If either set is empty.
    """
    chosen = dataset.get("train").bool()
    if chosen.all() or not chosen.any():
        raise ValueError(
            f"{name} needs episodes to train on and held-out ones (key 'train'): record it with "
            "held_out_per_task of at least 1 and less than per_task"
        )
    return dataset[chosen], dataset[~chosen]  # pyright: ignore[reportReturnType]


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


def _initialized(seed: int, make: Callable[..., Network], *arguments: Any) -> Network:
    """Return a network with initial weights drawn from a seed, without use of global state."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return make(*arguments)


def _take_frame_network(
    name: str, datasets: Sequence[TensorDictBase], fit: Fit, seed: int
) -> FrameNetwork:
    """Return a frame network of one's own, with the scale of its latents in some datasets."""
    frames = torch.cat([valid_frames(dataset) for dataset in datasets])
    network = _initialized(seed, make_frame_network, name, frames.shape[1:3]).to(fit.device)
    _set_scale(network, frames, fit)
    return network


def _set_scale(network: FrameNetwork, frames: Tensor, fit: Fit) -> None:
    """Set the scale of latents from frames uint8 ``[F, H, W, 3]``."""
    chunks = (chunk.to(fit.device) for chunk in frames.split(64))
    with torch.no_grad():
        network.set_latent_scale(torch.cat([network.features(chunk) for chunk in chunks]))


def _train_vae(datasets: Sequence[TensorDictBase], config: VAEConfig, fit: Fit, seed: int) -> VAE:
    length = torch.cat([dataset.get("length") for dataset in datasets])
    if length.max() < config.window:
        raise ValueError(f"the dataset has no training demonstration of {config.window} frames")
    frames = torch.cat([valid_frames(dataset) for dataset in datasets])
    own = datasets[-1]
    action = torch.cat([_actions_of_frames(dataset, own) for dataset in datasets])
    # Actions of demonstrations are unknown, unless there is no play to learn from.
    n_known = int(own.get("length").sum()) if "action" in own else 0
    n_unknown = len(frames) - n_known
    first = length.cumsum(0) - length
    starts = torch.cat(
        [
            torch.arange(int(f), int(f) + int(n) - config.window + 1)
            for f, n in zip(first, length, strict=True)
        ]
    )

    def sample(generator: torch.Generator) -> TensorDict:
        n_windows = config.batch_size // config.window
        drawn = starts[torch.randint(len(starts), (n_windows,), generator=generator)]
        index = drawn.unsqueeze(-1) + torch.arange(config.window)
        windows = {"pixels": frames[index], "action": action[index]}
        return TensorDict({**windows, "action_known": drawn >= n_unknown}, [n_windows])

    generator = torch.Generator().manual_seed(seed)
    frame_shape = frames.shape[1:3]
    sizes = (config.latent_size, action.shape[-1], frame_shape, config.keypoints)
    vae = _initialized(seed, VAE, *sizes)
    vae.mean_frame.copy_(mean_frame(frames))
    loss = VAEInverseLoss(
        vae,
        reconstruction_weight=config.reconstruction_weight,
        kl_weight=config.kl_weight,
        inverse_weight=config.inverse_weight,
        generator=generator,
    )
    fit("vae", loss, sample, config, generator, config.bfloat16)
    vae.eval().requires_grad_(False)
    _set_scale(vae, frames, fit)
    return vae


def _actions_of_frames(dataset: TensorDictBase, own: TensorDictBase) -> Tensor:
    """Return the action after each valid frame, ``[sum(length), A]``; 0 if not of ``own``."""
    length, n_frames = dataset.get("length"), dataset.get("pixels").shape[1]
    action = own.get("action", torch.zeros(1, 1, 1))
    if dataset is not own or "action" not in own:
        action = torch.zeros(()).expand(len(length), n_frames - 1, action.shape[-1])
    # The padding after the last frame of a demonstration is never read.
    return torch.nn.functional.pad(action, (0, 0, 0, 1))[valid_steps(length, n_frames)]


def _steps_to_infer(episodes: TensorDictBase, config: InverseModelConfig) -> tuple[Tensor, Tensor]:
    """Return which steps have an action, and which a small enough one, both bool ``[N, T - 1]``."""
    action = episodes.get("action")
    limit = 1.0 if config.largest_action is None else config.largest_action
    valid = valid_steps(episodes.get("length") - 1, action.shape[1])
    return valid, action.abs().amax(-1) <= limit


def _check_actions(
    shown: TensorDictBase | None, own: TensorDictBase, config: InverseModelConfig
) -> None:
    """Check, before hours of training, that the inverse model sees what it is to infer.

    Args:
        shown: Demonstrations.
        own: Episodes that it learns from.
        config: Its settings.

    Raises:
        ValueError: If there is nothing to learn from, or hardly what demonstrations do.
    """
    for episodes, most in ((shown, 0.05), (own, 1.0)):
        if episodes is None or "action" not in episodes:
            continue
        valid, small = _steps_to_infer(episodes, config)
        left_out = float((valid & ~small).sum() / valid.sum())
        if left_out > most or left_out == 1:
            component = int(episodes.get("action")[valid].abs().mean(0).argmax())
            raise ValueError(
                f"largest_action {config.largest_action} leaves {left_out:.0%} of the actions out, "
                f"most by component {component}, and the inverse model would never see them: raise "
                "it (--config.inverse.largest-action, or largest_action of the scene), 1 keeps all"
            )


def _train_inverse(
    latent: Tensor,
    episodes: TensorDictBase,
    config: InverseModelConfig,
    fit: Fit,
    seed: int,
) -> InverseModel:
    """Train the inverse model on the latents ``[N, T, 64]`` and actions of episodes."""
    length, action = episodes.get("length"), episodes.get("action")
    valid, slow = _steps_to_infer(episodes, config)
    chosen = (slow & valid).nonzero()

    def sample(generator: torch.Generator) -> TensorDict:
        drawn = torch.randint(len(chosen), (config.batch_size,), generator=generator)
        episode, step = chosen[drawn].unbind(-1)
        windows = window(latent, length, episode, step)
        windows = windows + config.noise * torch.randn(windows.shape, generator=generator)
        return TensorDict({"window": windows, "action": action[episode, step]}, [len(drawn)])

    generator = torch.Generator().manual_seed(seed)
    sizes = (latent.shape[-1], action.shape[-1], config.hidden_size)
    inverse = _initialized(seed, InverseModel, *sizes)
    fit("inverse", ActionInferenceLoss(inverse), sample, config, generator)
    return inverse.eval().requires_grad_(False)


def _train_lae(
    latent: Tensor, length: Tensor, config: SequenceAutoencoderConfig, fit: Fit, seed: int
) -> SequenceAutoencoder:
    def sample(generator: torch.Generator) -> TensorDict:
        index = torch.randint(len(latent), (config.batch_size,), generator=generator)
        return TensorDict({"latent": latent[index], "length": length[index]}, [config.batch_size])

    generator = torch.Generator().manual_seed(seed)
    lae = _initialized(seed, SequenceAutoencoder, latent.shape[-1], config.embedding_size)
    fit("lae", SequenceReconstructionLoss(lae), sample, config, generator)
    return lae.eval().requires_grad_(False)
