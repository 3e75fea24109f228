"""Bank of embedded demonstrations, with the latents and actions along them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from bgpo_trl.errors import check_fetched
from bgpo_trl.files.tensor_file import digest, load_tensors, save_tensors
from bgpo_trl.scenes.scene import check_name

_LATENT_CODES, _ACTION_CODES = 25.0, 127.0
"""Int8 codes per standard deviation of a latent (range +-5.08) and per unit of action."""


@dataclass(frozen=True)
class DemonstrationSteps:
    """Latents and actions along demonstrations, quantized to 8 bits.

    The rounding error is at most 0.02 standard deviations of a latent and 0.004 of an action.

    Attributes:
        latent: Frames of all demonstrations, concatenated, int8 ``[F, 64]``.
        action: Action from each frame to the next, int8 ``[F, A]``; undefined at a last frame.
        first: Index of the first frame of each demonstration, int64 ``[N]``.
        length: Number of frames of each, int64 ``[N]``; 0 if its steps are not kept.
        joints: Readings of the robot's joints in each frame, float32 ``[F, J]``, not quantized;
            None if they are unknown.

    Raises:
        ValueError: If shapes or dtypes do not match, or an index lies outside ``latent``.
    """

    latent: Tensor
    action: Tensor
    first: Tensor
    length: Tensor
    joints: Tensor | None = None

    def __post_init__(self) -> None:
        if not (
            self.latent.dtype == self.action.dtype == torch.int8
            and self.first.dtype == self.length.dtype == torch.int64
            and self.latent.ndim == self.action.ndim == 2
            and len(self.latent) == len(self.action)
            and self.first.shape == self.length.shape
            and bool((self.first >= 0).all() and (self.length >= 0).all())
            and bool((self.first + self.length <= len(self.latent)).all())
        ):
            raise ValueError("the shapes, dtypes or indices of its steps do not match")
        joints = self.joints
        if joints is not None and not (
            joints.dtype == torch.float32
            and joints.shape[:-1] == self.latent.shape[:1]
            and bool(joints.isfinite().all())
        ):
            raise ValueError("the joints of its steps are not finite float32 numbers of each frame")

    @classmethod
    def of(
        cls, latent: Tensor, action: Tensor, length: Tensor, joints: Tensor | None = None
    ) -> DemonstrationSteps:
        """Quantize padded demonstrations.

        Args:
            latent: Standardized latents ``[N, T, 64]``; clipped at five standard deviations.
            action: Actions in [-1, 1], ``[N, T - 1, A]``.
            length: Number of frames to keep of each, int64 ``[N]``.
            joints: Readings of the robot's joints, float32 ``[N, T, J]``, or None.

        Raises:
            ValueError: If a latent or an action is NaN or Inf.
        """
        valid = torch.arange(latent.shape[1]) < length.unsqueeze(-1)
        padded = torch.nn.functional.pad(action, (0, 0, 0, 1))
        latent, action = latent[valid], padded[valid]
        if not (latent.isfinite().all() and action.isfinite().all()):
            raise ValueError(
                "latents or actions of demonstrations are not finite: look for frames or actions "
                "that are not, or train the encoders again"
            )
        return cls(
            (latent * _LATENT_CODES).round().clamp(-127, 127).to(torch.int8),
            (action * _ACTION_CODES).round().clamp(-127, 127).to(torch.int8),
            length.cumsum(0) - length,
            length.clone(),
            None if joints is None else joints[valid],
        )

    def latents(self, frame: Tensor) -> Tensor:
        """Return the latents of frames int64 ``[...]``, float32 ``[..., 64]``."""
        return self.latent[frame] / _LATENT_CODES

    def actions(self, frame: Tensor) -> Tensor:
        """Return the actions taken at frames int64 ``[...]``, float32 ``[..., A]``."""
        return self.action[frame] / _ACTION_CODES

    def select(self, rows: Tensor) -> DemonstrationSteps:
        """Return the steps of selected demonstrations, sharing the memory of all frames."""
        return replace(self, first=self.first[rows], length=self.length[rows])

    def compact(self) -> DemonstrationSteps:
        """Return the steps without frames that belong to none of the demonstrations."""
        first = self.length.cumsum(0) - self.length
        frame = torch.arange(int(self.length.sum()))
        frame += (self.first - first).repeat_interleave(self.length)
        joints = None if self.joints is None else self.joints[frame]
        latent, action = self.latent[frame], self.action[frame]
        return replace(self, latent=latent, action=action, first=first, joints=joints)

    def __add__(self, other: DemonstrationSteps) -> DemonstrationSteps:
        """Concatenate the steps of two sets of demonstrations, with joints if both have some."""
        joints = [steps.joints for steps in (self, other) if steps.joints is not None]
        return DemonstrationSteps(
            torch.cat([self.latent, other.latent]),
            torch.cat([self.action, other.action]),
            torch.cat([self.first, other.first + len(self.latent)]),
            torch.cat([self.length, other.length]),
            torch.cat(joints) if len(joints) == 2 else None,
        )


@dataclass(frozen=True)
class DemonstrationBank:
    """Embedded demonstrations: the only form in which BGPO reads demonstrations.

    Attributes:
        embedding: Embeddings phi, float32 ``[N, 32]``.
        task: Task labels, int64 ``[N]``; used to draw an episode's task and for evaluation.
        train: Bool ``[N]``; ``False`` for demonstrations held out for test episodes.
        tasks: Task names, in the order of the labels.
        steps: Latents and actions along the demonstrations, or ``None`` if they are not stored.
        encoder_id: Identity of the encoders that embedded them (`Representation.identity`), or
            ``None`` if unknown.
        spread: Share of the range of start states that the demonstrations were recorded over.
        scene: Identity of the scene that they show (`Scene.identity`), or ``None`` if unknown.
        noise: Standard deviation of the noise that states to imitate should get (`choose_noise`).

    Raises:
        ValueError: If shapes or dtypes do not match, an embedding is not finite, a label has no
            name, or a name is given twice.
    """

    embedding: Tensor
    task: Tensor
    train: Tensor
    tasks: tuple[str, ...]
    steps: DemonstrationSteps | None = None
    encoder_id: str | None = None
    spread: float = 1.0
    scene: str | None = None
    noise: float = 0.2

    def __post_init__(self) -> None:
        embedding, task, train = self.embedding, self.task, self.train
        if not (
            embedding.ndim == 2
            and task.shape == train.shape == embedding.shape[:1]
            and (embedding.dtype, task.dtype, train.dtype)
            == (torch.float32, torch.int64, torch.bool)
            and embedding.isfinite().all()
        ):
            raise ValueError("its embeddings, tasks or parts have wrong shapes, or NaN")
        for name in self.tasks:
            check_name(name)
        if len({*self.tasks}) < len(self.tasks):
            raise ValueError(f"a task is named twice in {', '.join(self.tasks)}: name each once")
        unknown = task[(task < 0) | (task >= len(self.tasks))]
        if len(unknown):
            raise ValueError(
                f"a demonstration has task label {int(unknown[0])}, but tasks names only "
                f"{len(self.tasks)}: {', '.join(self.tasks)}"
            )
        if self.steps is not None and len(self.steps.first) != len(self.embedding):
            n_steps, n = len(self.steps.first), len(embedding)
            raise ValueError(
                f"the bank has steps of {n_steps} demonstrations, but embeddings of {n}"
            )

    @property
    def identity(self) -> str:
        """Digest of the demonstrations and their noise, without the names of their tasks."""
        noise = torch.tensor(self.noise, dtype=torch.float64)
        return digest({**self._tensors(), "noise": noise})

    def seen(self, most: int = 0) -> DemonstrationBank:
        """Return the demonstrations for training episodes, or the first ``most`` of each task.

        Raises:
            ValueError: If a task has fewer than ``most``.
        """
        seen = self._select(self.train)
        if not most:
            return seen
        few = (seen.task.bincount(minlength=len(self.tasks)) < most).nonzero().flatten().tolist()
        if few:
            raise ValueError(
                f"the bank has fewer than {most} demonstrations of {self.tasks[few[0]]!r} for "
                "training: choose fewer"
            )
        return seen._select(_place(seen.task) < most)

    def held_out(self, part: Literal["validation", "test"] | None = None) -> DemonstrationBank:
        """Return the demonstrations for test episodes, or a part of them.

        ``"validation"`` (first, third, ... of each task) is for choosing settings, ``"test"``
        (second, fourth, ...) for reporting results.

        Raises:
            ValueError: If there is no such part.
        """
        if part not in (None, "validation", "test"):
            raise ValueError(f"part must be 'validation', 'test' or None, got {part!r}")
        rows = torch.nonzero(~self.train).flatten()
        if part is None:
            return self._select(rows)
        return self._select(rows[_place(self.task[rows]) % 2 == (part == "test")])

    def of_task(self, task: int) -> DemonstrationBank:
        """Return the demonstrations of one task."""
        return self._select(self.task == task)

    def for_tasks(self, tasks: Sequence[str]) -> DemonstrationBank:
        """Return the demonstrations of the given tasks, relabeled by their positions in ``tasks``.

        Raises:
            ValueError: If the bank does not know one of the tasks.
        """
        missing = [name for name in tasks if name not in self.tasks]
        if missing:
            raise ValueError(
                f"the bank has no demonstration of {missing[0]!r}, only of "
                f"{', '.join(self.tasks)}: record and embed some, for --bank (docs/extending.md)"
            )
        label = torch.tensor([tasks.index(n) if n in tasks else -1 for n in self.tasks])
        kept = self._select(label[self.task] >= 0)
        return replace(kept, task=label[kept.task], tasks=tuple(tasks))

    def __add__(self, other: DemonstrationBank) -> DemonstrationBank:
        """Concatenate two banks, with the noise of the first; new task names are appended.

        Raises:
            ValueError: If they were embedded by different encoders, or show different scenes.
        """
        if self.encoder_id != other.encoder_id:
            raise ValueError(
                f"one bank was embedded by the encoders {self.encoder_id}, the other by "
                f"{other.encoder_id}: embed both by the same (`bgpo bank`)"
            )
        if self.scene != other.scene:
            raise ValueError(
                f"one bank shows the scene {self.scene}, the other {other.scene}: record both in "
                "the same"
            )
        tasks = tuple(dict.fromkeys((*self.tasks, *other.tasks)))
        label = torch.tensor([tasks.index(name) for name in other.tasks])
        return replace(
            self,
            embedding=torch.cat([self.embedding, other.embedding]),
            task=torch.cat([self.task, label[other.task]]),
            train=torch.cat([self.train, other.train]),
            tasks=tasks,
            steps=None if self.steps is None or other.steps is None else self.steps + other.steps,
            spread=min(self.spread, other.spread),
        )

    def _select(self, rows: Tensor) -> DemonstrationBank:
        return replace(
            self,
            embedding=self.embedding[rows],
            task=self.task[rows],
            train=self.train[rows],
            steps=None if self.steps is None else self.steps.select(rows),
        )

    def save(self, path: str | Path) -> None:
        """Write the bank as safetensors, with the identities of scene and encoders.

        Raises:
            ValueError: If ``encoder_id`` is unknown.
            OSError: If the file cannot be written; an existing file is kept.
        """
        if self.encoder_id is None:
            raise ValueError("set encoder_id: a saved bank says which encoders embedded it")
        meta = {
            "encoder_id": self.encoder_id,
            "tasks": json.dumps(self.tasks),
            "spread": str(self.spread),
            "noise": str(self.noise),
        }
        if self.scene is not None:
            meta["scene"] = self.scene
        save_tensors(path, self._tensors(), meta)

    def _tensors(self) -> dict[str, Tensor]:
        tensors = {"embedding": self.embedding, "task": self.task, "train": self.train}
        if self.steps is not None:
            steps = vars(self.steps.compact())
            tensors |= {f"steps.{key}": value for key, value in steps.items() if value is not None}
        return tensors

    @classmethod
    def load(cls, path: str | Path, *, encoder_id: str) -> DemonstrationBank:
        """Read a bank.

        Raises:
            ValueError: If it is missing, damaged, or was made by other encoders.
        """
        remedy = "make it again with `bgpo bank`, or use `--train-encoders`"
        check_fetched(Path(path))
        try:
            tensors, meta = load_tensors(path)
            columns = {k.removeprefix("steps."): t for k, t in tensors.items() if "." in k}
            bank = cls(
                **{key: tensor for key, tensor in tensors.items() if "." not in key},
                tasks=tuple(json.loads(meta["tasks"])),
                steps=DemonstrationSteps(**columns) if columns else None,
                encoder_id=encoder_id,
                spread=float(meta["spread"]),
                scene=meta.get("scene"),
                noise=float(meta.get("noise", cls.noise)),
            )
        except FileNotFoundError:
            raise ValueError(f"there is no demonstration bank at {path}; {remedy}") from None
        except (ValueError, TypeError, KeyError, RecursionError) as error:
            raise ValueError(f"{path} is damaged or not a bank ({error}); {remedy}") from None
        if meta.get("encoder_id") != encoder_id:
            raise ValueError(
                f"{path} was embedded by the encoders {str(meta.get('encoder_id'))[:12]}, not by "
                f"{encoder_id[:12]}; {remedy}"
            )
        return bank


def _place(task: Tensor) -> Tensor:
    """Return the position of each demonstration among those of its task, from 0."""
    labels = task.unsqueeze(-1)
    same = labels == torch.arange(int(task.max()) + 1 if len(task) else 1)
    return same.cumsum(0).gather(-1, labels).flatten() - 1
