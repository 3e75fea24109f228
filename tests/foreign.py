"""Checkpoints that no run has written, under names that a run would give them."""

import hashlib
import io
import pickle
import shutil
from pathlib import Path
from typing import Any

import torch

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
    "a tensor": _saved(torch.zeros(3)),
    "half a dict": _saved({"algorithm": {}, "settings": {}}),
    "settings in words": _saved({"algorithm": {}, "settings": "bgpo"}),
    "a class of somebody else": _saved({"settings": Path()}),
    "another pickle": pickle.dumps({"settings": 1}),
    "a malicious pickle": pickle.dumps(Malice()),
    "a picture": b"\x89PNG\r\n" * 20,
    "nothing": b"",
}
"""Bytes of the checkpoint, by what is in it."""


def put_checkpoint(run: Path, content: bytes) -> None:
    """Replaces the checkpoints of a run by one of this content, with the digest of it."""
    shutil.rmtree(run / "checkpoint")
    (run / "checkpoint").mkdir()
    digest = hashlib.sha256(content).hexdigest()[:16]
    (run / "checkpoint" / f"checkpoint-000007-{digest}.pt").write_bytes(content)
