from pathlib import Path

import pytest
import torch

from bgpo_trl.data.dataset import load_demonstrations
from tests.helpers import edit

KEYS = {"pixels", "state", "action", "length", "task", "train", "seed"}


def truncate(path: Path) -> None:
    with open(path / "pixels.memmap", "r+b") as file:
        file.truncate(1000)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (truncate, r"pixels\.memmap is missing or truncated; remove .*"),
        (lambda p: (p / "dataset.json").write_text("{"), r"dataset\.json is damaged; remove .*"),
        (lambda p: (p / "dataset.json").unlink(), r"copy is not a dataset of demonstrations; .*"),
        (lambda p: edit(p / "dataset.json", checksum=None), r"is not complete; resume it with .*"),
        (
            lambda p: edit(p / "dataset.json", scene_version="old"),
            r"was recorded in scene 'old', this is nico",
        ),
    ],
)
def test_what_is_not_whole_is_refused_in_one_line(copy, damage, message):
    damage(copy)

    with pytest.raises(ValueError, match=message) as error:
        load_demonstrations(copy)

    assert "\n" not in str(error.value)
    if "resume" not in message:
        assert "record it again with `python -m bgpo_trl.data.recording PATH`" in str(error.value)


@pytest.mark.parametrize("meta", ["{", '{"_type": "os.system"}', None])
def test_what_says_how_to_read_the_tensors_is_not_believed(recorded, copy, meta):
    """TensorDict's own file is not under the checksum, and may name what to unpickle."""
    (copy / "meta.json").unlink() if meta is None else (copy / "meta.json").write_text(meta)
    found, expected = load_demonstrations(copy), load_demonstrations(recorded)
    assert set(found.keys()) == KEYS
    for key in KEYS:
        torch.testing.assert_close(found[key], expected[key], rtol=0, atol=0)
