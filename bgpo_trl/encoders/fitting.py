"""Supervised training of one network, with logs and checkpoints."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torchrl.objectives import LossModule

from bgpo_trl.configs import (
    InverseModelConfig,
    RepresentationConfig,
    SequenceAutoencoderConfig,
    VAEConfig,
)
from bgpo_trl.files.checkpoint import has_checkpoint, load_checkpoint, save_checkpoint
from bgpo_trl.files.progress import progress_bar

Log = Callable[[dict[str, Any]], None]
"""Consumer of a training log's rows: ``stage``, ``step``, ``learning_rate`` and the losses."""


Schedule = VAEConfig | SequenceAutoencoderConfig | InverseModelConfig
"""Steps and learning rates of a stage."""


@dataclass(frozen=True)
class Fit:
    """Training loop of both encoders: Adam, by default with warm-up and cosine decay.

    Attributes:
        config: Hyperparameters; the seed and the intervals apply to every stage.
        folder: Parent of the stages' checkpoint folders; ``None`` disables checkpoints.
        log: Receives a row every ``config.log_every`` steps.
        progress: Whether to show a progress bar.
        device: Device to train on.
        frame_network: Identity of the frame network of one's own whose latents it is trained on, or
            "": a checkpoint of another one is not resumed.
    """

    config: RepresentationConfig
    folder: Path | None
    log: Log | None
    progress: bool
    device: torch.device | str = "cpu"
    frame_network: str = ""

    def __call__(
        self,
        stage: str,
        loss: LossModule,
        sample: Callable[[torch.Generator], TensorDict],
        schedule: Schedule,
        generator: torch.Generator,
        bfloat16: bool = False,
    ) -> None:
        """Train ``loss.parameters()`` on the device, from the last checkpoint if there is one.

        Args:
            stage: Name of the progress bar, the log rows and the checkpoint.
            loss: Maps a batch to a TensorDict whose ``loss_*`` entries are summed.
            sample: Draws a batch, on the CPU.
            schedule: Gradient steps and learning rate of the stage.
            generator: The only source of randomness of ``sample`` and ``loss``; saved in the
                checkpoint, so that a resumed training gives the same weights.
            bfloat16: Whether to compute the loss in bfloat16 where that is precise enough.

        Raises:
            ValueError: If the loss is no longer finite, or the checkpoints are damaged or belong to
                another configuration.
            OSError: If a checkpoint cannot be written.
        """
        loss.to(self.device)
        optimizer = torch.optim.Adam(loss.parameters(), lr=schedule.learning_rate)
        path = self.folder / stage if self.folder else None
        start = self._resume(path, loss, optimizer, generator)
        bar = progress_bar(
            f"train {stage}",
            range(start, schedule.steps),
            shown=self.progress,
            initial=start,
            total=schedule.steps,
        )
        for step in bar:
            rate = schedule.learning_rate * _factor(step, schedule)
            for group in optimizer.param_groups:
                group["lr"] = rate
            batch = sample(generator).to(self.device)
            with torch.autocast(torch.device(self.device).type, torch.bfloat16, enabled=bfloat16):
                losses = loss(batch)
            objective = [value for key, value in losses.items() if key.startswith("loss_")]
            optimizer.zero_grad()
            torch.stack(objective).sum().backward()
            optimizer.step()
            done = step + 1
            if done % self.config.log_every == 0 or done == schedule.steps:
                parts = {key: value.item() for key, value in losses.items()}
                if not all(math.isfinite(value) for value in parts.values()):
                    raise ValueError(f"{stage} diverged at step {done}: lower its learning_rate")
                shown = {k.removeprefix("loss_"): f"{v:.3g}" for k, v in parts.items()}
                bar.set_postfix(shown, refresh=False)
                if self.log:
                    self.log({"stage": stage, "step": done, "learning_rate": rate, **parts})
            if path and (done % self.config.checkpoint_every == 0 or done == schedule.steps):
                state = {
                    "config": self._settings,
                    "step": done,
                    "loss": loss.state_dict(),
                    "optimizer": optimizer.state_dict(),
                    "generator": generator.get_state(),
                }
                save_checkpoint(path, state)

    @property
    def _settings(self) -> str:
        """All that a checkpoint has to have in common with the training that it resumes."""
        return json.dumps(asdict(self.config)) + self.frame_network

    def _resume(
        self,
        path: Path | None,
        loss: LossModule,
        optimizer: torch.optim.Optimizer,
        generator: torch.Generator,
    ) -> int:
        if not path or not has_checkpoint(path):
            return 0
        saved = load_checkpoint(path)
        if not saved.keys() >= {"config", "loss", "optimizer", "generator", "step"}:
            raise ValueError(f"{path} holds no checkpoint of encoders: choose another folder")
        if saved["config"] != self._settings:
            raise ValueError(
                f"{path} was written with another configuration or frame network: "
                "remove it or choose another checkpoint folder"
            )
        loss.load_state_dict(saved["loss"])
        optimizer.load_state_dict(saved["optimizer"])
        generator.set_state(saved["generator"])
        return saved["step"]


def _factor(step: int, schedule: Schedule) -> float:
    """Return the share of the peak learning rate at a step."""
    warmup = min(1.0, (step + 1) / schedule.warmup_steps)
    return (
        warmup * (1 + math.cos(math.pi * step / schedule.steps)) / 2 if schedule.decay else warmup
    )
