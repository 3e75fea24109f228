"""Checkpoints: what is saved is loaded, and no crash or full disk loses the one before."""

import warnings
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from bgpo_trl.files.checkpoint import has_checkpoint, load_checkpoint, save_checkpoint
from tests.helpers import largest_file


def files(directory: Path) -> list[Path]:
    return sorted(directory.iterdir())


def test_a_state_is_loaded_as_it_was_saved(tmp_path):
    plain = {"int": 10**30, "float": float("-inf"), "list": [True, None, ("a", 0.1)]}
    plain["numpy"] = np.random.default_rng(3).bit_generator.state
    pixels = torch.arange(6, dtype=torch.uint8).reshape(2, 3)
    path = save_checkpoint(tmp_path, {"plain": plain, "pixels": pixels})
    assert load_checkpoint(tmp_path)["plain"] == plain

    # Tensors that are mapped from the file do not change it, and outlive it.
    before = path.read_bytes()
    mapped = load_checkpoint(tmp_path, mmap=True)["pixels"]
    assert mapped.dtype == torch.uint8 and mapped.tolist() == [[0, 1, 2], [3, 4, 5]]
    mapped.zero_()
    assert path.read_bytes() == before
    path.unlink()
    assert mapped.sum() == 0


def test_the_newest_is_loaded_the_one_before_kept_and_leftovers_of_a_kill_ignored(tmp_path):
    directory = tmp_path / "run" / "checkpoint"
    assert not has_checkpoint(directory)
    paths = [save_checkpoint(directory, {"episode": episode}) for episode in range(12)]
    assert has_checkpoint(directory)
    assert load_checkpoint(directory) == {"episode": 11}
    assert files(directory) == paths[-2:]

    (directory / "checkpoint.tmp").write_bytes(b"half a checkpoint")
    (directory / "checkpoint-notes.pt").write_bytes(b"not ours")
    assert load_checkpoint(directory) == {"episode": 11}
    newest = save_checkpoint(directory, {"episode": 12})
    assert load_checkpoint(directory) == {"episode": 12}
    assert files(directory) == [paths[-1], newest, directory / "checkpoint-notes.pt"]


@settings(max_examples=200)
@given(where=st.floats(0, 1, exclude_max=True), bit=st.integers(-1, 7))
def test_a_damaged_checkpoint_is_skipped_with_a_warning_or_read_as_it_was(
    where, bit, tmp_path_factory
):
    directory = tmp_path_factory.mktemp("checkpoint")
    save_checkpoint(directory, {"weight": torch.arange(100.0), "episode": 1})
    newer = save_checkpoint(directory, {"weight": torch.arange(100.0), "episode": 2})
    content = bytearray(newer.read_bytes())
    position = int(where * len(content))
    if bit < 0:
        del content[position:]
    else:
        content[position] ^= 1 << bit
    newer.write_bytes(content)

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        state = load_checkpoint(directory)
    # Some bytes, such as padding, mean nothing.
    skipped = [f"{newer.name} is damaged" in str(warning.message) for warning in caught]
    assert (state["episode"], skipped) in ((1, [True]), (2, []))
    assert torch.equal(state["weight"], torch.arange(100.0))

    newest = save_checkpoint(directory, {"weight": torch.arange(100.0), "episode": 3})
    assert set(files(directory)) == {newer, newest}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load_checkpoint(directory)["episode"] == 3


@settings(max_examples=15)
@given(room=st.floats(0, 1, exclude_max=True))
def test_a_full_disk_keeps_earlier_checkpoints(room, tmp_path_factory):
    directory = tmp_path_factory.mktemp("checkpoint")
    first, second, third = ({"weight": torch.ones(5000), "episode": n} for n in (1, 2, 3))
    kept = [save_checkpoint(directory, state) for state in (first, second)]
    size = int(room * kept[-1].stat().st_size)
    with largest_file(size), pytest.raises(OSError, match="earlier ones are kept: make room"):
        save_checkpoint(directory, third)
    assert files(directory) == kept
    assert load_checkpoint(directory)["episode"] == 2
    save_checkpoint(directory, third)
    assert load_checkpoint(directory)["episode"] == 3


@pytest.mark.parametrize(
    ("state", "cause"),
    [
        ({"rng": np.random.default_rng(0)}, "state['rng'] is a Generator"),
        ({"a": [0.0, {"b": np.float64(1)}]}, "state['a'][1]['b'] is a float64"),
        ({"a": OrderedDict({(1, 2): 0})}, "state['a'] has the key (1, 2)"),
        (torch.nn.Linear(1, 1), "state is a Linear"),
    ],
)
def test_a_state_that_could_not_be_loaded_is_not_saved(state: Any, cause: str, tmp_path, refused):
    refused(lambda: save_checkpoint(tmp_path / "checkpoint", state), cause, "")
