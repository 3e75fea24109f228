import os

import numpy as np
from bgpo_trl.doctor.finding import Finding
from PIL import Image

from bgpo_trl.doctor import frames


def told(finding: Finding) -> tuple[str, str]:
    assert "\n" not in str(finding)
    return finding.level, finding.told


def test_frames_are_shown_not_to_be_blank_and_to_follow_the_arm():
    frame = np.random.default_rng(0).integers(0, 255, (32, 64, 3), np.uint8)
    moved = frame.copy()
    moved[3, 4:7] ^= 1
    seen = told(frames.judge_frames(frame, moved))
    assert seen[0] == "ok"
    assert seen[1].endswith(" 3 pixels change as the arm moves")
    assert told(frames.judge_frames(frame, frame.copy()))[1].startswith("stays the same when the")
    blank = np.full_like(frame, 7)
    level, message = told(frames.judge_frames(blank, moved))
    assert level == "wrong"
    assert message.startswith("blank, 1 colours: try MUJOCO_GL=egl")


def test_a_real_frame_is_drawn_and_written(tmp_path):
    opengl, frame, written = frames.check_frame(tmp_path / "frame.png")
    assert {opengl.level, frame.level, written.level} == {"ok"}
    assert opengl.told.startswith(f"{os.environ['MUJOCO_GL']}, ")
    assert "unknown" not in opengl.told
    picture = np.asarray(Image.open(tmp_path / "frame.png"))
    assert picture.shape == (320, 640, 3)
    assert picture.std() > 10


def test_a_frame_that_cannot_be_written_is_told(tmp_path):
    *_, written = frames.check_frame(tmp_path / "absent" / "frame.png")
    assert written.level == "wrong"
    assert "choose another for --frame" in written.told


def test_a_renderer_that_draws_nothing_is_found_out(monkeypatch):
    monkeypatch.setattr(
        "suites.nico.rendering.FrameRenderer.render",
        lambda self, data, out=None: np.zeros((32, 64, 3), np.uint8),
    )
    assert [finding.level for finding in frames.check_frame()] == ["ok", "wrong"]
