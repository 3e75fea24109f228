"""Datasets of demonstrations: damaged ones, and those that are written from elsewhere."""

import os
import shutil
import warnings
from collections.abc import Sequence
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from bgpo_trl.data.dataset import (
    load_demonstrations,
    read_meta,
    resize_frames,
    write_demonstrations,
)
from tests.helpers import edit


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda p: os.truncate(p / "pixels.memmap", 1000), r"memmap is missing or truncated"),
        (lambda p: (p / "dataset.json").write_text("{"), r"dataset\.json is damaged"),
        (lambda p: (p / "dataset.json").unlink(), "not a dataset of demonstrations"),
        (lambda p: edit(p / "dataset.json", scene_version="old"), "recorded in scene 'old'"),
        (lambda p: edit(p / "dataset.json", action_size=3), r"action_size 3, the scene 'nico' 4"),
        (lambda p: edit(p / "dataset.json", state_size=3), r"state_size 3, the scene 'nico' 16"),
        (
            lambda p: edit(p / "dataset.json", frame_shape=[8, 8]),
            r"frame_shape \[8, 8\], the scene",
        ),
    ],
)
def test_what_is_not_whole_is_refused_in_one_line(copy, damage, message):
    damage(copy)
    with pytest.raises(ValueError, match=message) as error:
        load_demonstrations(copy)
    assert "\n" not in str(error.value)
    assert "record it again with `bgpo record PATH`" in str(error.value)


TASKS = ("grasp_glass", "push_green_to_white")


def episode_of(length, seed=0, keys=("pixels", "action", "state")):
    """An episode of noise."""
    rng = np.random.default_rng([seed, length])
    episode = {
        "pixels": rng.integers(0, 256, (length, 32, 64, 3), dtype=np.uint8),
        "action": rng.uniform(-1, 1, (length - 1, 4)),
        "state": rng.normal(size=(length, 16)),
    }
    return {key: episode[key] for key in keys}


def episodes_of(**options):
    """Three episodes of one task, four of another."""
    return {
        TASKS[0]: [episode_of(length, **options) for length in (5, 3, 4)],
        TASKS[1]: [episode_of(length, **options) for length in (2, 7, 6, 3)],
    }


def write(path, episodes, **options):
    return write_demonstrations(
        path, episodes, **{"scene": "nico", "held_out_per_task": 1} | options
    )


@pytest.mark.parametrize("keys", [("pixels",), ("pixels", "action"), ("pixels", "state")])
def test_a_dataset_has_the_given_entries_in_order_and_zeros_beyond_them(tmp_path, keys):
    episodes = episodes_of(keys=keys)
    write(tmp_path / "own", episodes)
    dataset = load_demonstrations(tmp_path / "own")

    assert {*dataset.keys()} == {*keys, "length", "task", "train", "seed"}
    assert dataset["length"].tolist() == [5, 3, 4, 2, 7, 6, 3]
    assert dataset["task"].tolist() == [0, 0, 0, 1, 1, 1, 1]
    assert dataset["train"].tolist() == [True, True, False, True, True, True, False]
    assert dataset["pixels"].shape == (7, 7, 32, 64, 3)
    for row, episode in zip(dataset, episodes[TASKS[0]] + episodes[TASKS[1]], strict=True):
        for key, values in episode.items():
            expected = torch.from_numpy(values).to(row[key].dtype)
            assert row[key][: len(values)].equal(expected)
            assert not row[key][len(values) :].any()
    assert read_meta(tmp_path / "own")["tasks"] == [*TASKS]


class OnDemand(Sequence):
    """Episodes that are made when they are indexed."""

    def __len__(self):
        return 3

    def __getitem__(self, number):
        return {key: torch.from_numpy(v) for key, v in episode_of(number + 2).items()}


def test_episodes_may_be_tensors_that_are_loaded_on_demand(tmp_path):
    lazy = write(tmp_path / "lazy", {TASKS[0]: OnDemand()})
    eager = write(tmp_path / "eager", {TASKS[0]: [episode_of(n) for n in (2, 3, 4)]})
    assert (lazy == eager).all()


@pytest.mark.parametrize(
    ("second", "cause"),
    [
        (lambda pixels: pixels[:-1], "is another one when read again"),
        (lambda pixels: pixels / 255, "has pixels float64"),
    ],
)
def test_an_episode_that_changes_between_two_readings_is_refused(tmp_path, refused, second, cause):
    class Changing(OnDemand):
        n_read = 0

        def __getitem__(self, number):
            self.n_read += 1
            pixels = episode_of(number + 4)["pixels"]
            return {"pixels": pixels if self.n_read <= len(self) else second(pixels)}

    refused(lambda: write(tmp_path / "own", {TASKS[0]: Changing()}), cause, "episode 0 of ")


def test_episodes_without_movement_and_such_as_are_given_twice_are_named(tmp_path):
    moving = episode_of(4, keys=("pixels",))
    still = {"pixels": moving["pixels"][:1].repeat(3, 0)}
    with pytest.warns(UserWarning) as caught:
        write(tmp_path / "own", {TASKS[0]: [moving, still, moving], TASKS[1]: [still, moving]})
    assert [str(one.message) for one in caught] == [
        f"2 of 5 episodes, such as 1 of '{TASKS[0]}', show one frame throughout: did the camera "
        "stand still?",
        f"3 of 5 episodes, such as 2 of '{TASKS[0]}', have the frames of an earlier one: give "
        "each once",
    ]


FRAMES = episode_of(52)["pixels"]


@pytest.mark.parametrize(
    ("frames", "doubt"),
    [
        (FRAMES, "have more steps than the scene's 50: at another rate, or not cut?"),
        (FRAMES[[0] * 6 + [1, 2, 3]], "begin with 5 or more steps that change nothing: cut them"),
        (FRAMES[[0, 1, 2] + [3] * 6], "end with 5 or more steps that change nothing: cut them off"),
        (FRAMES[[0, 0, 2, 2, 4, 4, 6, 6, 8]], "repeat every other frame: is the camera slower"),
        ((FRAMES[:9] / 255).astype(np.uint8), "have no color above 1: are they fractions"),
        (FRAMES[:51], None),
        (FRAMES[[0] * 5 + [1, 1, 1, 1]], None),
    ],
)
def test_episodes_that_are_not_cut_or_at_another_rate_or_of_fractions_are_named(
    tmp_path, frames, doubt
):
    """Four steps without change may be part of a task."""
    with warnings.catch_warnings(record=True) as caught:
        write(tmp_path / "own", {TASKS[0]: [{"pixels": frames}, episode_of(4, keys=("pixels",))]})
    assert [doubt in str(one.message) for one in caught] == ([] if doubt is None else [True])


def changed(**entries):
    """Episodes of which the third of the second task is changed; None removes an entry."""
    episodes = episodes_of()
    episode = {**episodes[TASKS[1]][2], **entries}
    episodes[TASKS[1]][2] = {key: value for key, value in episode.items() if value is not None}
    return episodes


MISSING = {**episodes_of(), TASKS[1]: [episode_of(2), episode_of(7), None, episode_of(3)]}


@pytest.mark.parametrize(
    ("episodes", "cause", "remedy"),
    [
        (MISSING, "episode 2 of 'push_green_to_white' is missing", "leave the episode out"),
        (changed(pixels=None), "has 'action', 'state'", "give 'pixels'"),
        (changed(actions=0), "has 'pixels'", "give 'pixels', and if known 'action'"),
        (changed(action=None), "has 'pixels', 'state'", "of all episodes or of none"),
        (changed(pixels=np.zeros((6, 48, 64, 3), np.uint8)), "48 x 64", "resize_frames"),
        (changed(pixels=np.zeros((6, 32, 64, 3))), "has pixels float64", "give uint8"),
        (changed(pixels=np.zeros((6, 32, 64), np.uint8)), "[6, 32, 64]", "[T, H, W, 3]"),
        (changed(pixels=np.zeros((1, 32, 64, 3), np.uint8)), "[1, 32, 64, 3]", "at least 2"),
        (changed(action=np.zeros((6, 4))), "has the action float64 [6, 4]", "[5, 4]"),
        (changed(action=[["left"] * 4] * 5), "has the action", "give [5, 4] numbers"),
        (changed(action=np.full((5, 4), -1.5)), "an action of size 1.5", "scale actions"),
        (changed(action=np.full((5, 4), 1.0001)), "an action of size 1.0001:", "scale actions"),
        (
            changed(action=np.full((5, 4), np.nan)),
            "action that are not finite",
            "leave the episode out",
        ),
        (changed(state=np.full((6, 16), 1e39)), "state that are not finite", "leave the episode"),
        (changed(state=np.zeros((6, 15))), "has the state", "give [6, 16] numbers"),
        ({}, "there are no episodes", "give some"),
        ({**episodes_of(), "push_green_to_glass": []}, "no episode of", "leave the task out"),
        ({TASKS[0]: iter([episode_of(4)])}, "has a list_iterator", "give a list"),
        ({"grasp_glass": [episode_of(3)]}, "'grasp_glass' has 1 episodes", "lower held_out"),
        ({"juggle": [episode_of(3)] * 2}, "no task 'juggle'", "add it first"),
    ],
)
def test_invalid_episodes_are_refused_before_anything_is_written(
    tmp_path, refused, episodes, cause, remedy
):
    refused(lambda: write(tmp_path / "made" / "own", episodes), cause, remedy)


def test_what_cannot_be_written_leaves_nothing(tmp_path, monkeypatch, refused):
    call = partial(write, tmp_path / "own", episodes_of())
    for options in ({"held_out_per_task": -1}, {"spread": 1.5}, {"scene": "mars"}):
        refused(partial(call, **options), str(*options.values()), "")
    usage = shutil.disk_usage(tmp_path)._replace(free=1000)
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "disk_usage", lambda _: usage)
        refused(call, "", "make room or choose another folder")
    call()
    again = partial(write, tmp_path / "own", episodes_of(seed=1))
    refused(again, "exists", "choose another folder, or remove it")


@pytest.mark.parametrize(
    "frames",
    [
        np.full((1, 4, 4, 3), 0.5, np.float32),  # was black
        np.full((1, 4, 4, 3), 3_000, np.uint16),  # was noise
        np.full((1, 4, 4, 3), np.nan),  # was black
        np.zeros((4, 4, 3), np.uint8),
        np.zeros((1, 4, 4, 4), np.uint8),
    ],
)
def test_frames_that_resizing_would_have_to_convert_are_refused(frames):
    with pytest.raises(ValueError, match=r"give uint8 \[T, H, W, 3\] \(0 to 255\)"):
        resize_frames(frames, (2, 2))
    with pytest.raises(ValueError, match="frame_shape must be a whole number, at least 1"):
        resize_frames(np.zeros((1, 4, 4, 3), np.uint8), (0, 2))


def test_resized_frames_are_means_of_areas():
    frame = np.arange(2 * 4 * 3, dtype=np.uint8).reshape(1, 2, 4, 3)
    # The means of (0, 3, 12, 15) and (6, 9, 18, 21), of the first channel.
    assert resize_frames(frame, (1, 2)).tolist() == [[[[8, 8, 10], [14, 14, 16]]]]


@settings(max_examples=20)
@given(arrays(np.uint8, (3, 4, 6, 3)), st.integers(1, 3), st.integers(1, 3))
def test_resizing_keeps_enlarged_frames(frames, by_height, by_width):
    large = frames.repeat(by_height, 1).repeat(by_width, 2)
    np.testing.assert_array_equal(resize_frames(large, (4, 6)), frames)
    np.testing.assert_array_equal(resize_frames(frames, large.shape[1:3]), large)
