import errno
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
    generator = torch.Generator().manual_seed(3)
    numpy_generator = np.random.default_rng(3)
    layer = torch.nn.Linear(2, 2)
    optimizer = torch.optim.Adam(layer.parameters())
    layer(torch.ones(2)).sum().backward()
    optimizer.step()
    save_checkpoint(
        tmp_path,
        {
            "torch": generator.get_state(),
            "numpy": numpy_generator.bit_generator.state,
            "layer": layer.state_dict(),
            "optimizer": optimizer.state_dict(),
            "plain": {"int": 10**30, "float": float("-inf"), "list": [True, None, ("a", 0.1)]},
            "pixels": torch.arange(6, dtype=torch.uint8).reshape(2, 3),
        },
    )
    expected = torch.rand(3, generator=generator), numpy_generator.random(3)

    state = load_checkpoint(tmp_path)

    generator.set_state(state["torch"])
    numpy_generator.bit_generator.state = state["numpy"]
    assert torch.equal(torch.rand(3, generator=generator), expected[0])
    assert np.array_equal(numpy_generator.random(3), expected[1])
    assert torch.equal(state["layer"]["weight"], layer.weight)
    fresh = torch.optim.Adam(torch.nn.Linear(2, 2).parameters())
    fresh.load_state_dict(state["optimizer"])
    assert torch.equal(fresh.state_dict()["state"][0]["exp_avg"], torch.full((2, 2), 0.1))
    assert state["plain"] == {"int": 10**30, "float": -np.inf, "list": [True, None, ("a", 0.1)]}
    assert state["pixels"].dtype == torch.uint8
    assert state["pixels"].tolist() == [[0, 1, 2], [3, 4, 5]]


def test_the_newest_is_loaded_and_the_one_before_is_kept(tmp_path):
    directory = tmp_path / "run" / "checkpoint"
    assert not has_checkpoint(directory)
    paths = [save_checkpoint(directory, {"episode": episode}) for episode in range(12)]
    assert has_checkpoint(directory)
    assert load_checkpoint(directory) == {"episode": 11}
    assert files(directory) == paths[-2:]


@settings(max_examples=60, deadline=None)
@given(where=st.floats(0, 1, exclude_max=True), bit=st.integers(-1, 7))
def test_a_damaged_checkpoint_is_skipped_with_a_warning(where, bit, tmp_path_factory):
    directory = tmp_path_factory.mktemp("checkpoint")
    intact = save_checkpoint(directory, {"weight": torch.arange(100.0), "episode": 1})
    newer = save_checkpoint(directory, {"weight": torch.arange(100.0), "episode": 2})
    content = bytearray(newer.read_bytes())
    position = int(where * len(content))
    if bit < 0:
        del content[position:]
    else:
        content[position] ^= 1 << bit
    newer.write_bytes(content)

    with pytest.warns(UserWarning, match=f"{newer.name} is damaged"):
        state = load_checkpoint(directory)
    assert state["episode"] == 1
    assert torch.equal(state["weight"], torch.arange(100.0))

    newest = save_checkpoint(directory, {"weight": torch.arange(100.0), "episode": 3})
    assert set(files(directory)) == {intact, newer.with_suffix(".damaged"), newest}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load_checkpoint(directory)["episode"] == 3


def test_without_an_intact_checkpoint_loading_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"no intact checkpoint.*start a new run"):
        load_checkpoint(tmp_path)
    with pytest.raises(ValueError, match="no intact checkpoint"):
        load_checkpoint(tmp_path / "nowhere")
    for episode in range(2):
        save_checkpoint(tmp_path, {"episode": episode}).write_bytes(b"")
    with (
        pytest.warns(UserWarning, match="damaged"),
        pytest.raises(ValueError, match=r"no intact checkpoint") as error,
    ):
        load_checkpoint(tmp_path)
    assert "\n" not in str(error.value)


@settings(max_examples=40, deadline=None)
@given(room=st.floats(0, 1, exclude_max=True))
def test_a_full_disk_keeps_earlier_checkpoints(room, tmp_path_factory):
    directory = tmp_path_factory.mktemp("checkpoint")
    kept = [
        save_checkpoint(directory, {"weight": torch.ones(5000), "episode": episode})
        for episode in (1, 2)
    ]
    size = int(room * kept[-1].stat().st_size)
    with largest_file(size), pytest.raises(OSError, match="earlier ones are kept") as error:
        save_checkpoint(directory, {"weight": torch.ones(5000), "episode": 3})
    assert error.value.errno == errno.EFBIG
    assert files(directory) == kept
    assert load_checkpoint(directory)["episode"] == 2
    save_checkpoint(directory, {"weight": torch.ones(5000), "episode": 3})
    assert load_checkpoint(directory)["episode"] == 3


def test_leftovers_of_a_killed_save_are_ignored(tmp_path):
    save_checkpoint(tmp_path, {"episode": 1})
    (tmp_path / "checkpoint.tmp").write_bytes(b"half a checkpoint")
    (tmp_path / "checkpoint-notes.pt").write_bytes(b"not ours")
    assert load_checkpoint(tmp_path) == {"episode": 1}
    save_checkpoint(tmp_path, {"episode": 2})
    assert load_checkpoint(tmp_path) == {"episode": 2}
    assert (tmp_path / "checkpoint-notes.pt").exists()
    assert not (tmp_path / "checkpoint.tmp").exists()


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ({"rng": np.random.default_rng(0)}, r"state\['rng'\] is a Generator"),
        ({"a": [0.0, {"b": np.float64(1)}]}, r"state\['a'\]\[1\]\['b'\] is a float64"),
        ({"path": Path()}, r"state\['path'\] is a PosixPath"),
        ({"array": np.zeros(2)}, r"state\['array'\] is a ndarray"),
        ({"a": OrderedDict({(1, 2): 0})}, r"state\['a'\] has the key \(1, 2\)"),
        (torch.nn.Linear(1, 1), "state is a Linear"),
    ],
)
def test_a_state_that_could_not_be_loaded_is_not_saved(state: Any, message: str, tmp_path):
    directory = tmp_path / "checkpoint"
    with pytest.raises(ValueError, match=message):
        save_checkpoint(directory, state)
    assert not directory.exists()


def test_memory_mapped_tensors_do_not_change_the_file(tmp_path):
    state = {"weights": torch.arange(5.0), "nested": [{"frames": torch.ones(3, dtype=torch.uint8)}]}
    path = save_checkpoint(tmp_path, state)
    before = path.read_bytes()
    loaded = load_checkpoint(tmp_path, mmap=True)
    assert loaded["weights"].equal(state["weights"])
    assert loaded["nested"][0]["frames"].equal(state["nested"][0]["frames"])
    loaded["weights"].zero_()
    assert path.read_bytes() == before
    path.unlink()
    assert loaded["nested"][0]["frames"].sum() == 3
