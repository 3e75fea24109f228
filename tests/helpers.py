"""Files of runs, damage done to them, and stand-ins, for tests of several packages."""

import csv
import io
import itertools
import json
import pickle
import resource
import shutil
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from fractions import Fraction
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.record.loggers.common import Logger

from bgpo_trl.configs import (
    InverseModelConfig,
    RepresentationConfig,
    SequenceAutoencoderConfig,
    VAEConfig,
)
from bgpo_trl.training import Trainer

DISTINCT = (
    "bgpo",
    "bgpo-single",
    "group-balanced-replay",
    "maml-demonstrations",
    "dist-nll-demonstrations",
    "oracle-demonstrations",
    "ddpg",
    "fine-tuning-demonstrations",
    "ewc-demonstrations",
)
"""An algorithm of each kind: others differ in values of settings, or in less to store and learn."""

TINY_ENCODERS = RepresentationConfig(
    vae=VAEConfig(batch_size=4, window=2, steps=4, warmup_steps=1),
    lae=SequenceAutoencoderConfig(batch_size=4, steps=4, warmup_steps=1),
    inverse=InverseModelConfig(hidden_size=8, batch_size=8, steps=4, warmup_steps=1),
)
"""A training of encoders that ends within a second."""


POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:ab\nsize 9\n"
"""What Git leaves in place of a file if Git LFS is not installed."""


def noise_demonstrations(
    lengths: Sequence[int], shape: tuple[int, int] = (32, 64), n_actions: int = 4, held_out: int = 1
) -> TensorDict:
    """Return demonstrations of noise by three tasks in turn, of which the last are held out."""
    generator, n, longest = torch.Generator().manual_seed(0), len(lengths), max(lengths)
    length = torch.tensor([*lengths])
    inside = torch.arange(longest) < length.unsqueeze(-1)  # beyond, there are zeros
    pixels = torch.randint(256, (n, longest, *shape, 3), generator=generator, dtype=torch.uint8)
    action = torch.rand(n, longest - 1, n_actions, generator=generator) * 2 - 1
    state = torch.randn(n, longest, 16, generator=generator)
    entries = {
        "pixels": pixels * inside[:, :, None, None, None],
        "action": action * inside[:, 1:, None],
        "state": state * inside[:, :, None],
        "length": length,
        "task": torch.arange(n) % 3,
        "train": torch.arange(n) < n - held_out,
    }
    return TensorDict(entries, [n])


def contents(folder: Path) -> dict[Path, bytes | None]:
    """Return all that lies below a folder: the bytes of each file, None for a folder."""
    return {
        path.relative_to(folder): path.read_bytes() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
    }


def rows(path: str | Path) -> list[dict[str, str]]:
    """Return the rows of a CSV file."""
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def cells(text: str) -> list[list[str]]:
    """Return the cells of a table in Markdown: first the head, then the rows."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    table = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return [table[0], *table[2:]]


def edit(path: Path, **changes: object) -> None:
    """Change entries of a JSON file; None removes an entry."""
    found = {**json.loads(path.read_text()), **changes}
    removed = {key for key, value in changes.items() if value is None}
    path.write_text(json.dumps({k: v for k, v in found.items() if k not in removed}))


def through_a_file(state: Any) -> Any:
    """Return a state as a checkpoint would return it."""
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """Have the kernel refuse to write files beyond a size, as a full disk would."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


UNPICKLED: list[str] = []


class Malice:
    """Betrays whoever unpickles it."""

    def __reduce__(self):
        return UNPICKLED.append, ("unpickled",)


def _saved(state: Any) -> bytes:
    content = io.BytesIO()
    torch.save(state, content)
    return content.getvalue()


CHECKPOINTS = {
    "a list": _saved([1, 2]),
    "half a dict": _saved({"algorithm": {}, "settings": {}}),
    "settings in words": _saved({"algorithm": {}, "settings": "bgpo"}),
    "a class of somebody else": _saved({"settings": Path()}),
    "a malicious pickle": pickle.dumps(Malice()),
    "a picture": b"\x89PNG\r\n" * 20,
}
"""Bytes of a checkpoint that no run has written, by what is in it."""


def put_checkpoint(run: Path, content: bytes) -> None:
    """Replace the checkpoints of a run by one of this content."""
    shutil.rmtree(run / "checkpoint")
    (run / "checkpoint").mkdir()
    (run / "checkpoint" / "checkpoint-000007.pt").write_bytes(content)


def at_step(trainer: Trainer, n: int, do: Callable[[], object]) -> None:
    """Call `do` during the n-th step, when the simulation has moved and the replay has not."""
    store, steps = trainer.algorithm.store, itertools.count(1)

    def store_after(transition: TensorDictBase) -> None:
        if next(steps) == n:
            do()
        store(transition)

    trainer.algorithm.store = store_after


def finish(trainer: Trainer) -> Trainer:
    """Run to the end and close; return the trainer."""
    with trainer:
        trainer.run()
    return trainer


def interrupt(trainer: Trainer, step: int, number: int = signal.SIGINT) -> None:
    """Run until a signal during a step, which is to end the run after it; close."""
    at_step(trainer, step, lambda: signal.raise_signal(number))
    with trainer, pytest.raises(KeyboardInterrupt):
        trainer.run()


def interrupt_call(trainer: Trainer, owner: object, name: str, n: int) -> None:
    """Run until the n-th call of a method, in place of which there is an interrupt; close."""
    method, calls = getattr(owner, name), itertools.count(1)

    def stop(*arguments: Any) -> Any:
        if next(calls) == n:
            raise KeyboardInterrupt
        return method(*arguments)

    with pytest.MonkeyPatch.context() as patch, trainer, pytest.raises(KeyboardInterrupt):
        patch.setattr(owner, name, stop)
        trainer.run()


def spied(owner: Any, name: str, patch: pytest.MonkeyPatch | None = None) -> list[Any]:
    """Have a method keep its calls; return the list of their copied arguments and results.

    Without ``patch``, it does so as long as its owner lives.
    """
    calls, method = [], getattr(owner, name)

    def call(*arguments: Any, **options: Any) -> Any:
        given = [each.clone() if hasattr(each, "clone") else each for each in arguments]
        calls.append((given, method(*arguments, **options)))
        return calls[-1][1]

    (patch.setattr if patch else setattr)(owner, name, call)
    return calls


class FilmStandIn(ModuleType):
    """The part of PyAV that reads a film, of frames by number; the only keyframe is the first."""

    def __init__(self, shown, fps, pix_fmt="yuv420p", *, n_streams=1, corrupt=None, **container):
        super().__init__("av")
        self.__spec__ = ModuleSpec("av", None)
        self.shown, self.fps, self.corrupt = shown, fps, corrupt
        bits = SimpleNamespace(bits=8 if pix_fmt == "yuv420p" else 16)
        stream = SimpleNamespace(
            format=SimpleNamespace(name=pix_fmt, components=[bits]),
            average_rate=Fraction(fps),
            time_base=Fraction(1, fps),
            start_time=0,
            duration=max(shown) + 1,
        )
        self.streams = type("Streams", (list,), {"video": [stream]})([stream] * n_streams)
        vars(self).update(container)

    def open(self, file):
        assert Path(file).exists()
        return nullcontext(self)

    def seek(self, start, stream): ...

    def decode(self, stream=None, video=0):
        for number, pixels in self.shown.items():
            yield SimpleNamespace(
                time=number / self.fps,
                is_corrupt=number == self.corrupt,
                side_data={},
                format=SimpleNamespace(components=()),
                to_ndarray=lambda format, pixels=pixels: pixels,
            )


class Recorder(Logger):
    """Logger that keeps metrics with their steps, and settings, in place of a service."""

    def __init__(self):
        super().__init__("run", "")
        self.metrics, self.settings, self.closed = [], [], False

    def _create_experiment(self):
        return None

    def log_metrics(self, metrics, step=None, *, keys_sep="/"):
        assert not self.closed
        self.metrics.append((metrics, step))
        return metrics

    def log_hparams(self, cfg):
        self.settings.append(cfg)

    def shutdown(self, timeout=None):
        self.closed = True
