import re
import shutil

import numpy as np
import pytest
import torch

from bgpo_trl.data import recording as demonstrations
from bgpo_trl.data.dataset import load_demonstrations, open_dataset, read_meta
from bgpo_trl.data.recording import record_demonstrations
from bgpo_trl.scenes import nico as nico_scene
from suites import nico
from suites.nico.demonstrator import Demonstrator
from tests.helpers import contents, edit

TINY = {"per_task": 3, "held_out_per_task": 1, "progress": False}
ONE = {"tasks": ["grasp_glass"], "per_task": 1, "held_out_per_task": 0, "progress": False}
KEYS = {"pixels", "state", "action", "length", "task", "train", "seed"}


def test_recording_returns_what_loading_does(recorded):
    dataset = load_demonstrations(recorded)
    assert set(dataset.keys()) == KEYS
    shapes = {"pixels": (51, 32, 64, 3), "state": (51, 16), "action": (50, 4)}
    for key in KEYS:
        assert dataset[key].shape == (9, *shapes.get(key, ()))
    assert dataset["pixels"].dtype == torch.uint8
    assert dataset["length"].dtype == dataset["task"].dtype == torch.int64
    assert dataset["task"].tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2]
    assert dataset["train"].tolist() == [True, True, False] * 3
    assert dataset["seed"].tolist() == [0] * 9
    again = record_demonstrations(recorded, **TINY)  # complete: only opened
    for key in KEYS:
        torch.testing.assert_close(again[key], dataset[key], rtol=0, atol=0)


def test_demonstrations_differ_from_each_other_and_between_seeds(recorded, tmp_path):
    starts = load_demonstrations(recorded)["state"][:, 0]
    other = record_demonstrations(tmp_path, seed=1, **ONE)
    assert len(torch.cat([starts, other["state"][:, 0]]).unique(dim=0)) == 10


def test_each_demonstration_does_its_task(recorded):
    for row in load_demonstrations(recorded):
        length, task, state = int(row["length"]), int(row["task"]), row["state"]
        assert 10 < length <= 51
        assert (row["pixels"][:length].float().std(dim=(1, 2, 3)) > 10).all()
        assert state[:length].abs().sum(-1).min() > 0
        assert row["action"][: length - 1].abs().sum(-1).min() > 0
        assert row["action"].abs().max() <= 1
        for key, end in (("pixels", length), ("state", length), ("action", length - 1)):
            assert not row[key][end:].any()
        start, last = (state[step, 7:].view(3, 3) for step in (0, length - 1))
        if task == 0:
            assert (state[length - 1, 4:7] - last[0]).norm() < 0.04
        else:
            # Not further than a standing glass or a box turned by 45 degrees allows.
            target = (0, 2)[task - 1]
            assert (last[1] - last[target])[:2].norm() < 0.08
            assert (start[1] - start[target])[:2].norm() > 0.1


def test_play_follows_a_demonstration_and_then_moves_at_random(tmp_path):
    options = {"per_task": 4, "held_out_per_task": 1, "progress": False}
    play = record_demonstrations(tmp_path / "play", play=True, **options)
    whole = play["length"] == 51
    assert whole.float().mean() > 0.5  # the rest have come far enough to succeed
    assert len(play["state"][:, 0].unique(dim=0)) == 12
    action = play["action"][whole]
    early, late = action[:, :2].std(), action[:, -15:].std()
    assert late > 0.25  # a demonstrator moves by less
    assert early < late
    reach = play["state"][whole][:, :, 4:7]
    assert (reach[:, -1] - reach[:, 0]).norm(dim=-1).mean() > 0.1
    # Nothing of it passes as demonstrations, and the other way round.
    for wrong in (False, True):
        with pytest.raises(ValueError, match="holds another recording"):
            changed = options | {"per_task": 4 + wrong}
            record_demonstrations(tmp_path / "play", play=wrong, **changed)
    one, again = (record_demonstrations(tmp_path / name, play=True, **ONE) for name in "ab")
    for key in KEYS:
        assert again[key].equal(one[key])


def test_a_demonstration_that_fails_is_tried_again(tmp_path, monkeypatch):
    attempts = []

    class ClumsyAtFirst(Demonstrator):
        def reset(self):
            super().reset()
            attempts.append(self)

        def __call__(self, timestep):
            return super().__call__(timestep) if len(attempts) > 2 else np.zeros(4)

    monkeypatch.setattr(nico_scene, "Demonstrator", ClumsyAtFirst)
    dataset = record_demonstrations(tmp_path, **ONE)
    assert len(attempts) >= 3
    assert dataset["action"].abs().sum() > 1


class Fickle(nico.TASKS["push_green_to_white"]):
    """A task that is solved until it is not, since its success test is broken."""

    times = 4  # Each success is asked for twice: for the reward, and for the end.

    def succeeded(self, physics):
        if Fickle.times == 0 or not super().succeeded(physics):
            return False
        Fickle.times -= 1
        return True


def test_a_demonstrator_that_never_succeeds_is_told_of(tmp_path, monkeypatch):
    nico.add_task("fickle", Fickle)
    options = {"tasks": ["grasp_glass", "fickle"], "per_task": 4, "held_out_per_task": 1}
    with pytest.raises(RuntimeError, match=r"'fickle' failed 3 times in a row \(2 of") as raised:
        record_demonstrations(tmp_path, attempts=3, progress=False, **options)
    tried, percent = map(int, re.search(r"2 of (\d+) .* (\d+)%", str(raised.value)).groups())
    assert tried >= 5
    assert percent == round(200 / tried)
    before = open_dataset(tmp_path, read_meta(tmp_path))["length"].clone()
    assert (before > 0).tolist() == [True] * 6 + [False] * 2
    monkeypatch.setattr(Fickle, "times", 99)
    mended = record_demonstrations(tmp_path, attempts=50, progress=False, **options)
    assert (mended["length"] > 0).all()
    assert mended["length"][:6].equal(before[:6])


def test_an_interrupted_recording_ends_as_an_uninterrupted_one(recorded, tmp_path, monkeypatch):
    record = demonstrations._Recorder.demonstrate
    rows = []

    def interrupted(recorder, task, row):
        rows.append(row)
        if len(rows) == 5:
            raise KeyboardInterrupt
        return record(recorder, task, row)

    monkeypatch.setattr(demonstrations._Recorder, "demonstrate", interrupted)
    with pytest.raises(KeyboardInterrupt):
        record_demonstrations(tmp_path, **TINY)
    with pytest.raises(ValueError, match=r"is not complete; resume it with the same command$"):
        load_demonstrations(tmp_path)
    record_demonstrations(tmp_path, **TINY)

    assert rows == [0, 1, 2, 3, 4, 4, 5, 6, 7, 8]  # none twice but the one it was at
    assert contents(tmp_path) == contents(recorded)


def test_missing_rows_are_recorded_again(recorded, copy):
    length = np.memmap(copy / "length.memmap", np.int64, "r+")
    length[[1, 8]] = 0
    length.flush()
    pixels = np.memmap(copy / "pixels.memmap", np.uint8, "r+").reshape(9, -1)
    pixels[8, :1000] = 7  # as after a kill in the middle of a row
    pixels.flush()
    edit(copy / "dataset.json", checksum=None)
    record_demonstrations(copy, **TINY)
    assert contents(copy) == contents(recorded)


def test_another_recording_is_not_continued(copy):
    before = contents(copy)
    for wrong in ({"seed": 1}, {"tasks": ["grasp_glass"]}):
        with pytest.raises(ValueError, match="holds another recording"):
            record_demonstrations(copy, **{**TINY, **wrong})
    assert contents(copy) == before


def test_what_cannot_be_recorded_leaves_nothing(tmp_path, monkeypatch):
    for wrong, message in (
        ({"held_out_per_task": 3}, "it must be less than per_task, 3"),
        ({"per_task": 0}, "it must be less than per_task, 0"),
        ({"seed": -1}, "seed must be at least 0"),
    ):
        with pytest.raises(ValueError, match=message):
            record_demonstrations(tmp_path / "new", **{**TINY, **wrong})
    usage = shutil.disk_usage(tmp_path)._replace(free=10**6)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    with pytest.raises(OSError, match="make room"):
        record_demonstrations(tmp_path / "new", **TINY)
    assert not list(tmp_path.iterdir())
