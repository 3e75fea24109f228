"""Frames of other sizes than the paper's."""

import numpy as np
import pytest

from suites import nico


def middle_of_glass(frame: np.ndarray) -> float:
    """Return the horizontal position of the glass in a frame, from 0 (left) to 1 (right)."""
    red, green, blue = np.moveaxis(frame.astype(int), -1, 0)
    return np.nonzero((red > 2 * green) & (red > 2 * blue))[1].mean() / frame.shape[1]


@pytest.mark.parametrize("frame_size", [(84, 84), (64, 128), [48, 32], (np.int64(100), 80)])
def test_frames_of_any_size_show_all_of_the_table(load, frame_size):
    env = nico.load("grasp_glass", seed=0, frame_size=frame_size)
    spec = env.observation_spec()["pixels"]

    pixels = env.reset().observation["pixels"]
    env.close()

    assert spec.shape == (*frame_size, 3)
    spec.validate(pixels)
    paper = load("grasp_glass", seed=0).reset().observation["pixels"]
    assert middle_of_glass(pixels) == pytest.approx(middle_of_glass(paper), abs=0.02)


@pytest.mark.parametrize("frame_size", [(0, 84), (84, 641), (84,), (84, 84, 3), 84, (84.0, 84)])
def test_sizes_that_frames_cannot_have_are_refused(frame_size):
    with pytest.raises(ValueError, match="frame_size"):
        nico.load("grasp_glass", frame_size=frame_size)


def test_a_size_other_than_the_shared_renderers_is_refused(renderer):
    with pytest.raises(ValueError, match="frame_size"):
        nico.load("grasp_glass", frame_size=(84, 84), renderer=renderer)
