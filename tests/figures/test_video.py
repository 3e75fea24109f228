import numpy as np
import pytest
from PIL import Image

from bgpo_trl.figures.frames import save_gif


def test_frames_come_back_at_their_pace_and_enlarged(tmp_path):
    frames = np.zeros((4, 2, 3, 3), np.uint8)
    for index, color in enumerate([(255, 0, 0), (0, 255, 0), (0, 0, 255), (90, 90, 90)]):
        frames[index] = color
        frames[index, 0, 1] = 255
    save_gif(frames, tmp_path / "videos" / "colors.gif", fps=4.0, scale=2)
    with Image.open(tmp_path / "videos" / "colors.gif") as video:
        assert video.n_frames == 4
        assert video.info["loop"] == 0
        for index, frame in enumerate(frames):
            video.seek(index)
            assert video.info["duration"] == 250
            shown = np.asarray(video.convert("RGB"))
            assert shown.shape == (4, 6, 3)
            for row, column in np.ndindex(4, 6):
                assert (shown[row, column] == frame[row // 2, column // 2]).all()


@pytest.mark.parametrize(
    "frames",
    [
        np.zeros((0, 2, 3, 3), np.uint8),
        np.zeros((2, 3, 3), np.uint8),
        np.zeros((1, 2, 3, 4), np.uint8),
        np.zeros((1, 2, 3, 3)),
    ],
)
def test_what_is_no_video_is_refused(frames, tmp_path):
    with pytest.raises(ValueError, match=r"frames must be uint8 \[T, H, W, 3\]"):
        save_gif(frames, tmp_path / "videos" / "none.gif")
    assert not list(tmp_path.iterdir())
