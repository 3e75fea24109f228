"""Pictures of episodes."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from suites.nico import explore
from suites.nico.explore import Arguments, main, picture_episode, write_pictures


@pytest.fixture(scope="module")
def pictures() -> list[Image.Image]:
    return picture_episode("push_green_to_white", seed=0)


def test_an_episode_is_pictured_step_by_step(pictures):
    assert 10 < len(pictures) <= 51
    assert {picture.size for picture in pictures} == {(320, 400)}
    frames = np.stack([np.asarray(picture) for picture in pictures])
    seen, room = frames[:, :160], frames[:, 160:]
    # Each pixel of the robot's frame is a square of 5 by 5.
    np.testing.assert_array_equal(seen, seen[:, ::5, ::5].repeat(5, axis=1).repeat(5, axis=2))
    for view in (seen, room):
        assert view.std() > 10
        assert all((first != second).any() for first, second in itertools.pairwise(view))


def test_pictures_become_a_strip_or_an_animation(pictures, tmp_path):
    write_pictures(tmp_path / "strip.png", pictures)
    strip = np.asarray(Image.open(tmp_path / "strip.png"))
    assert strip.shape == (400, 6 * 320, 3)
    np.testing.assert_array_equal(strip[:, :320], np.asarray(pictures[0]))
    np.testing.assert_array_equal(strip[:, -320:], np.asarray(pictures[-1]))
    write_pictures(tmp_path / "episode.gif", pictures)
    with Image.open(tmp_path / "episode.gif") as animation:
        assert animation.n_frames == len(pictures)
        assert animation.info["duration"] == 200  # (ms), the time of a step
    with pytest.raises(ValueError, match="png"):
        write_pictures(tmp_path / "episode.jpg", pictures)


def test_random_actions_and_demonstrations_differ(pictures):
    random = picture_episode("push_green_to_white", random=True, seed=0)
    assert np.asarray(random[0]).tolist() == np.asarray(pictures[0]).tolist()
    assert np.asarray(random[8]).tolist() != np.asarray(pictures[8]).tolist()


@pytest.mark.parametrize(
    ("out", "screen", "shown", "written"),
    [
        (None, True, True, None),
        (Path("a.gif"), True, False, "a.gif"),
        (None, False, False, "grasp_glass.png"),
    ],
)
def test_a_window_opens_only_on_a_screen(tmp_path, monkeypatch, out, screen, shown, written):
    viewed = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(explore, "has_screen", lambda: screen)
    monkeypatch.setattr(explore, "view", lambda *args, **kwargs: viewed.append(args))
    main(Arguments(task="grasp_glass", out=out))
    assert viewed == ([("grasp_glass",)] if shown else [])
    assert [path.name for path in tmp_path.iterdir()] == ([written] if written else [])
