"""Train the two encoders on demonstrations and play (Sec. III-A).

Datasets are those of `bgpo_trl.encoders.representation`.
"""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from bgpo_trl.configs import InverseModelConfig, RepresentationConfig
from bgpo_trl.data.dataset import check_scene
from bgpo_trl.encoders.representation import (
    Representation,
    encode_frames,
    initialized,
    mean_frame,
    part,
    split,
    valid_frames,
    valid_steps,
)
from bgpo_trl.files.checkpoint import has_checkpoint, load_checkpoint, save_checkpoint
from bgpo_trl.files.progress import progress_bar
from bgpo_trl.files.tensor_file import digest
from bgpo_trl.machine import has_bfloat16
from bgpo_trl.modules.frame_network import FrameNetwork, make_frame_network
from bgpo_trl.modules.inverse_model import InverseModel, window
from bgpo_trl.modules.sequence_autoencoder import SequenceAutoencoder
from bgpo_trl.modules.vae import VAE
from bgpo_trl.objectives.supervised import (
    action_inference_loss,
    sequence_reconstruction_loss,
    vae_inverse_loss,
)

Log = Callable[[dict[str, Any]], None]
"""Consumer of a training log's rows: ``stage``, ``step``, ``learning_rate`` and the losses."""


def train_representation(
    dataset: TensorDictBase,
    config: RepresentationConfig | None = None,
    *,
    play: TensorDictBase | None = None,
    scene: str,
    spread: float = 1.0,
    command: str = "",
    **how: Any,
) -> Representation:
    """Train both encoders on the training demonstrations.

    The VAE with its inverse model comes first; the LSTM autoencoder and the inverse model are
    trained on its latents. A frame network of one's own (``config.frame_network``) is taken as it
    is, and only the scale of its latents is set.

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
        **how: ``checkpoint``, ``log``, ``progress`` and ``device``, see `Fit`.

    Returns:
        The trained encoders, on the CPU, in eval mode, without gradients.

    Raises:
        ValueError: If the dataset or the configuration cannot be trained on, dataset or play show
            another scene, no imported module has the frame network, or ``checkpoint`` belongs to a
            training on other data or with another configuration; or if ``largest_action`` leaves no
            action to learn from, or more than a twentieth of those demonstrated out.
    """
    config = config or RepresentationConfig()
    check_scene(scene, dataset, play)
    train, _ = split(dataset)
    seen = [train] if play is None else [train, part(play, "the recorded play")]
    own = seen[-1]
    _check_actions(train, own, config.inverse)
    fit = Fit(config, **how).reading(*map(_read, seen))
    network = _frame_network(seen, fit)
    named = {}
    if network.identity != VAE.identity:
        shape = json.dumps(network.frame_shape)
        named = {"frame_network": network.identity, "frame_shape": shape}
        weights = digest(network.state_dict())
        fit = replace(fit, read=(*fit.read, f"{network.identity} {weights}"))
    latent = encode_frames(network, train)
    lae = _train_lae(latent, train.get("length"), fit)
    inverse = None
    if config.inverse.steps and "action" in own:
        inverse = _train_inverse(latent if play is None else encode_frames(network, own), own, fit)
    metadata = {
        "scene": scene,
        "spread": str(spread),
        "config": json.dumps(asdict(config)),
        "seed": str(config.seed),
        "command": command,
        **named,
    }
    return Representation(network.cpu(), lae, inverse, metadata)


def retrain_inverse(
    representation: Representation,
    play: TensorDictBase,
    config: RepresentationConfig | None = None,
    *,
    shown: TensorDictBase | None = None,
    command: str = "",
    **how: Any,
) -> Representation:
    """Train the inverse model of encoders anew, on the training part of ``play``; keep the rest.

    What limits the inverse model is the amount of play (docs/learning.md), which costs little to
    record, whereas the other encoders would take longer to train on it. Of ``config``, the seed,
    the intervals and ``inverse`` are used. ``shown``, if given, are the demonstrations whose
    actions it is to infer, checked as by `train_representation`. Other arguments, the result and
    errors are as for `train_representation`; play without actions is refused, too.
    """
    fit = Fit(config or RepresentationConfig(), **how)
    if not fit.config.inverse.steps:
        raise ValueError("an inverse model of 0 steps would know nothing: give it some")
    check_scene(representation.metadata.get("scene"), play, shown)
    own = part(play, "the recorded play")
    if "action" not in own:
        raise ValueError("the inverse model learns from actions, which this play lacks: record it")
    _check_actions(shown, own, fit.config.inverse)
    network = representation.frame_network.to(fit.device)
    fit = fit.reading(_read(own), network.state_dict())
    inverse = _train_inverse(encode_frames(network, own), own, fit)
    metadata = representation.metadata
    kept = {**json.loads(metadata["config"]), "inverse": asdict(fit.config.inverse)}
    commands = "; ".join(part for part in (metadata["command"], command) if part)
    metadata = {**metadata, "config": json.dumps(kept), "command": commands}
    return Representation(network.cpu(), representation.lae, inverse, metadata)


@dataclass(frozen=True)
class Fit:
    """Training loop of both encoders: Adam, by default with warm-up and cosine decay.

    Attributes:
        config: Hyperparameters; the seed and the intervals apply to every stage.
        checkpoint: Folder for checkpoints, from which an interrupted training is resumed and then
            gives the same weights; None for none.
        log: Receives a row every ``config.log_every`` steps.
        progress: Whether to show a progress bar for each stage.
        device: Device to train on.
        read: Digests of what the training reads, see `reading`.
    """

    config: RepresentationConfig
    checkpoint: str | Path | None = None
    log: Log | None = None
    progress: bool = True
    device: torch.device | str = "cpu"
    read: tuple[str, ...] = ()

    def reading(self, *tensors: Mapping[str, Tensor]) -> Fit:
        """Return the same loop for a training that reads these tensors, too.

        A checkpoint of a training that has read others is not resumed.
        """
        if self.checkpoint is None:
            return self
        return replace(self, read=(*self.read, *map(digest, tensors)))

    def generator(self) -> torch.Generator:
        """Return the random numbers of a stage."""
        return torch.Generator().manual_seed(self.config.seed)

    def __call__(
        self,
        stage: str,
        network: nn.Module,
        loss_of: Callable[..., TensorDict],
        sample: Callable[[torch.Generator], TensorDict],
        generator: torch.Generator,
        bfloat16: bool = False,
    ) -> None:
        """Train a network on the device, from the last checkpoint if there is one.

        Args:
            stage: Name of its settings, the progress bar, the log rows and the checkpoint.
            network: Network to train.
            loss_of: Maps network and batch to a TensorDict whose ``loss_*`` entries are summed.
            sample: Draws a batch, on the CPU.
            generator: The only source of randomness of ``sample`` and ``loss_of``; saved in the
                checkpoint, so that a resumed training gives the same weights.
            bfloat16: Whether to compute the loss in bfloat16 where that is precise enough.

        Raises:
            ValueError: If the loss is no longer finite, or the checkpoints are damaged or belong to
                a training on other data or with another configuration.
            OSError: If a checkpoint cannot be written.
        """
        network.to(self.device)
        schedule = getattr(self.config, stage)
        steps, device = schedule.steps, torch.device(self.device)
        optimizer = torch.optim.Adam(network.parameters(), lr=schedule.learning_rate)
        path = Path(self.checkpoint) / stage if self.checkpoint else None
        start = self._resume(path, network, optimizer, generator)
        counts = {"initial": start, "total": steps}
        bar = progress_bar(f"train {stage}", range(start, steps), shown=self.progress, **counts)
        for step in bar:
            rate = schedule.learning_rate * min(1.0, (step + 1) / schedule.warmup_steps)
            if schedule.decay:
                rate *= (1 + math.cos(math.pi * step / steps)) / 2
            for group in optimizer.param_groups:
                group["lr"] = rate
            batch = sample(generator).to(self.device)
            with torch.autocast(device.type, torch.bfloat16, enabled=bfloat16):
                losses = loss_of(network, batch)
            objective = [value for key, value in losses.items() if key.startswith("loss_")]
            optimizer.zero_grad()
            torch.stack(objective).sum().backward()
            optimizer.step()
            done = step + 1
            if done % self.config.log_every == 0 or done == steps:
                parts = {key: value.item() for key, value in losses.items()}
                if not all(math.isfinite(value) for value in parts.values()):
                    raise ValueError(f"{stage} diverged at step {done}: lower its learning_rate")
                texts = {k.removeprefix("loss_"): f"{v:.3g}" for k, v in parts.items()}
                bar.set_postfix(texts, refresh=False)
                if self.log:
                    self.log({"stage": stage, "step": done, "learning_rate": rate, **parts})
            if path and (done % self.config.checkpoint_every == 0 or done == steps):
                state = {
                    "config": self._settings,
                    "step": done,
                    "network": network.state_dict(),
                    "optimizer": optimizer.state_dict(),
                    "generator": generator.get_state(),
                }
                save_checkpoint(path, state)

    @property
    def _settings(self) -> str:
        """All that a checkpoint has to have in common with the training that it resumes."""
        return " ".join((json.dumps(asdict(self.config)), *self.read))

    def _resume(
        self,
        path: Path | None,
        network: nn.Module,
        optimizer: torch.optim.Optimizer,
        generator: torch.Generator,
    ) -> int:
        """Restore the last checkpoint if there is one; return the number of steps made."""
        if not path or not has_checkpoint(path):
            return 0
        saved = load_checkpoint(path)
        if not saved.keys() >= {"config", "network", "optimizer", "generator", "step"}:
            raise ValueError(f"{path} holds no checkpoint of encoders: choose another folder")
        if saved["config"] != self._settings:
            raise ValueError(
                f"{path} is of a training on other data, or with another configuration or frame "
                "network: remove it or choose another folder (--folder)"
            )
        network.load_state_dict(saved["network"])
        optimizer.load_state_dict(saved["optimizer"])
        generator.set_state(saved["generator"])
        return saved["step"]


def _read(episodes: TensorDictBase) -> dict[str, Tensor]:
    """Return what encoders learn from."""
    return {key: episodes.get(key) for key in ("pixels", "length", "action") if key in episodes}


def _frame_network(datasets: Sequence[TensorDictBase], fit: Fit) -> FrameNetwork:
    """Train the VAE, or take a frame network of one's own; set the scale of its latents."""
    frames = torch.cat([valid_frames(dataset) for dataset in datasets])
    name, seed = fit.config.frame_network, fit.config.seed
    if name == "vae":
        network = _train_vae(datasets, frames, fit)
    else:
        network = initialized(seed, make_frame_network, name, frames.shape[1:3]).to(fit.device)
    chunks = (chunk.to(fit.device) for chunk in frames.split(64))
    with torch.no_grad():
        network.set_latent_scale(torch.cat([network.features(chunk) for chunk in chunks]))
    return network


def _train_vae(datasets: Sequence[TensorDictBase], frames: Tensor, fit: Fit) -> VAE:
    """Train the VAE on the frames of datasets, and its inverse model on actions of the last one."""
    config, own = fit.config.vae, datasets[-1]
    length = torch.cat([dataset.get("length") for dataset in datasets])
    if length.max() < config.window:
        raise ValueError(f"the dataset has no training demonstration of {config.window} frames")
    # Actions of demonstrations are unknown, unless there is no play to learn from.
    n_known = int(own.get("length").sum()) if "action" in own else 0
    n_unknown = len(frames) - n_known
    action = torch.zeros(n_unknown, 1)
    if n_known:
        # The padding after the last frame of a demonstration is never read.
        padded = torch.nn.functional.pad(own.get("action"), (0, 0, 0, 1))
        known = padded[valid_steps(own.get("length"), padded.shape[1])]
        action = torch.cat([known.new_zeros(n_unknown, known.shape[-1]), known])
    # Frames from which the episode has as many left as a window.
    n_left = torch.cat([torch.arange(n, 0, -1) for n in length.tolist()])
    starts = (n_left >= config.window).nonzero().flatten()

    def sample(generator: torch.Generator) -> TensorDict:
        n_windows = config.batch_size // config.window
        drawn = starts[torch.randint(len(starts), (n_windows,), generator=generator)]
        index = drawn.unsqueeze(-1) + torch.arange(config.window)
        windows = {"pixels": frames[index], "action": action[index]}
        return TensorDict({**windows, "action_known": drawn >= n_unknown}, [n_windows])

    sizes = (config.latent_size, action.shape[-1], frames.shape[1:3], config.keypoints)
    vae = initialized(fit.config.seed, VAE, *sizes)
    vae.mean_frame.copy_(mean_frame(frames))
    generator = fit.generator()
    loss_of = partial(vae_inverse_loss, config=config, generator=generator)
    bfloat16 = config.bfloat16 and has_bfloat16(torch.device(fit.device))
    if config.bfloat16 and not bfloat16:
        emulated = "this processor has no instructions for bfloat16: computing in float32"
        warnings.warn(emulated, stacklevel=2)
    fit("vae", vae, loss_of, sample, generator, bfloat16)
    return vae.eval().requires_grad_(False)


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

    If those of demonstrations are unknown, it warns of actions left out of what it learns from.

    Args:
        shown: Demonstrations, of whose actions at most a twentieth may be left out.
        own: Episodes that it learns from; some of their actions have to be left.
        config: Its settings.

    Raises:
        ValueError: If more actions are left out.
    """
    for episodes in (shown, own):
        if episodes is None or "action" not in episodes:
            continue
        valid, small = _steps_to_infer(episodes, config)
        left_out = float((valid & ~small).sum() / valid.sum())
        if left_out <= 0.05:
            continue
        component = int(episodes.get("action")[valid & ~small].abs().mean(0).argmax())
        told = (
            f"largest_action {config.largest_action} leaves {left_out:.0%} of the actions out, "
            f"most by component {component}, and the inverse model would never see them: raise "
            "it (`bgpo encoders --config.inverse.largest-action`, or largest_action of the "
            "scene), 1 keeps all"
        )
        if episodes is shown or left_out == 1:
            raise ValueError(told)
        if shown is None or "action" not in shown:
            warnings.warn(f"{told}; or leave it, if demonstrations have none", stacklevel=3)


def _train_inverse(latent: Tensor, episodes: TensorDictBase, fit: Fit) -> InverseModel:
    """Train the inverse model on the latents ``[N, T, 64]`` and actions of episodes."""
    config, length, action = fit.config.inverse, episodes.get("length"), episodes.get("action")
    valid, slow = _steps_to_infer(episodes, config)
    chosen = (slow & valid).nonzero()

    def sample(generator: torch.Generator) -> TensorDict:
        drawn = torch.randint(len(chosen), (config.batch_size,), generator=generator)
        episode, step = chosen[drawn].unbind(-1)
        windows = window(latent, length, episode, step)
        windows = windows + config.noise * torch.randn(windows.shape, generator=generator)
        return TensorDict({"window": windows, "action": action[episode, step]}, [len(drawn)])

    sizes = (latent.shape[-1], action.shape[-1], config.hidden_size)
    inverse = initialized(fit.config.seed, InverseModel, *sizes)
    fit("inverse", inverse, action_inference_loss, sample, fit.generator())
    return inverse.eval().requires_grad_(False).cpu()


def _train_lae(latent: Tensor, length: Tensor, fit: Fit) -> SequenceAutoencoder:
    """Train the sequence encoder on the latents ``[N, T, 64]`` of episodes."""
    config = fit.config.lae

    def sample(generator: torch.Generator) -> TensorDict:
        index = torch.randint(len(latent), (config.batch_size,), generator=generator)
        return TensorDict({"latent": latent[index], "length": length[index]}, [config.batch_size])

    sizes = (latent.shape[-1], config.embedding_size)
    lae = initialized(fit.config.seed, SequenceAutoencoder, *sizes)
    fit("lae", lae, sequence_reconstruction_loss, sample, fit.generator())
    return lae.eval().requires_grad_(False).cpu()
