"""`bgpo one-shot`: a film is read exactly or refused; what it prints is what the policy infers."""

import sys
from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

import bgpo_trl
from bgpo_trl.data.film import decode_frame, read_film
from bgpo_trl.errors import UnreadableError
from bgpo_trl.experiments import watch
from bgpo_trl.experiments.arguments import OneShotArguments
from bgpo_trl.experiments.watch import one_shot
from bgpo_trl.scenes import SimulationEnv
from tests.helpers import POINTER, FilmStandIn

pytestmark = pytest.mark.usefixtures("easy_world")
FRAMES = np.random.default_rng(0).integers(256, size=(11, 64, 128, 3), dtype=np.uint8)


@pytest.fixture
def film(tmp_path):
    """A folder of images; the one without a frame's ending is a note."""
    folder = tmp_path / "film"
    folder.mkdir()
    for number, frame in enumerate(FRAMES):
        Image.fromarray(frame).save(folder / f"{number:04}.png")
    (folder / "note.txt").write_text("top camera")
    return folder


def test_it_prints_what_the_policy_infers_and_plays_a_task(run_of, film):
    run = run_of("bgpo")
    policy = bgpo_trl.load_run(run)
    found = policy.condition(policy.preprocess(FRAMES, color="rgb"))
    told, node, group, labels, hint = one_shot(
        OneShotArguments(run=run, demonstration=film)
    ).splitlines()
    assert told == "11 frames of 64 x 128"
    assert node == f"behavior: node {found.node} of GWR-B, activity {found.activity:.2f}"
    assert group.startswith(f"group {found.group}, novelty {found.group_novelty:.2f}: ")
    lookup = policy.algorithm.groups[0].lookup
    own = [
        policy.tasks[task]
        for phi, task in zip(policy.bank.embedding, policy.bank.task, strict=True)
        if lookup(phi).group == found.group
    ]
    shares = ", ".join(f"{task} {n / len(own):.0%}" for task, n in Counter(own).most_common())
    assert labels == f"labels of the group, which the policy never reads: {shares}"
    assert hint == "--task NAME plays it in the simulation"

    task = policy.tasks[1]
    options = {"run": run, "demonstration": film, "task": task, "crop": (0, 0, 32, 64)}
    *_, played = one_shot(OneShotArguments(**options)).splitlines()
    assert played.startswith((f"{task}: success after ", f"{task}: no success after "))


def test_a_physical_robot_is_not_moved(run_of, film, monkeypatch):
    monkeypatch.setattr(watch, "RobotEnv", SimulationEnv)
    asked = OneShotArguments(run=run_of("bgpo"), demonstration=film, task="grasp_glass")
    with pytest.raises(ValueError, match="'nico' is a physical robot, which commands do not move"):
        one_shot(asked)


def test_frames_are_read_exactly_in_the_order_of_names(film):
    np.testing.assert_array_equal([*read_film(film)], FRAMES)
    for number in range(len(FRAMES)):
        (film / f"{number:04}.png").rename(film / f"frame {number}.png")
    np.testing.assert_array_equal([*read_film(film)], FRAMES)  # 10 after 9, not after 1
    for number in range(len(FRAMES)):  # by their time
        (film / f"frame {number}.png").rename(film / f"{number / 20:.2f}.png")
    np.testing.assert_array_equal([*read_film(film)], FRAMES)
    (film / "0.10.png").rename(film / "0.1.png")  # the first, or the tenth?
    with pytest.raises(UnreadableError, match=r"a point in its name.* number them"):
        next(read_film(film))


@pytest.mark.parametrize(
    ("numbers", "missing"),
    [
        ("3 4 5 7 8", "5.png and 7.png"),
        ("0 5 10 20 25", "10.png and 20.png"),  # every fifth frame
        ("1000 1033 1066 1100 1133", None),  # times
        ("0 10 40 50 70", None),  # too few are alike to tell
    ],
)
def test_a_frame_that_is_missing_is_told_by_its_number(tmp_path, numbers, missing):
    for number, frame in zip(numbers.split(), FRAMES, strict=False):
        Image.fromarray(frame).save(tmp_path / f"{number}.png")
    if missing is None:
        assert len([*read_film(tmp_path)]) == 5
    else:
        with pytest.raises(UnreadableError, match=rf"between .*{missing} is missing: get it, or"):
            next(read_film(tmp_path))


def test_images_are_upright_as_their_camera_says(tmp_path):
    image, exif = Image.fromarray(FRAMES[0]), Image.Exif()
    exif[0x0112] = 6  # to be turned by a quarter, clockwise
    image.save(tmp_path / "0.png", exif=exif)
    np.testing.assert_array_equal([*read_film(tmp_path)], [np.rot90(FRAMES[0], -1)])


def test_frames_of_films_are_upright_and_opaque():
    """Here in place of PyAV's."""

    def decoded(matrix=None, alpha=255):
        clear = np.dstack([FRAMES[0], np.full(FRAMES.shape[1:3], alpha, np.uint8)])
        components = [SimpleNamespace(is_alpha=channel == 3) for channel in range(4)]
        frame = SimpleNamespace(format=SimpleNamespace(components=components), side_data={})
        if matrix is not None:
            shown = [[*matrix[:2], 0], [*matrix[2:], 0], [0, 0, 1]]
            frame.side_data["DISPLAYMATRIX"] = np.array(shown, np.int32) << 16
        frame.to_ndarray = lambda format: {"rgb24": FRAMES[0], "rgba": clear}[format]
        return decode_frame(frame)

    for matrix, upright in (
        (None, FRAMES[0]),
        ((0, 1, -1, 0), np.rot90(FRAMES[0], -1)),  # of a phone held upright
        ((0, -1, 1, 0), np.rot90(FRAMES[0])),
        ((-1, 0, 0, -1), np.rot90(FRAMES[0], 2)),
        ((-1, 0, 0, 1), FRAMES[0][:, ::-1]),
    ):
        np.testing.assert_array_equal(decoded(matrix), upright)
    for wrong, cause in (({"alpha": 254}, "transparent"), ({"matrix": (1, 1, -1, 1)}, "a quarter")):
        with pytest.raises(UnreadableError, match=cause):
            decoded(**wrong)


@pytest.mark.parametrize(
    ("changes", "cause"),
    [
        ({}, None),
        ({"start_time": None}, None),
        ({"n_streams": 2, "duration": 9e5}, None),  # its sound goes on
        ({"duration": None}, None),
        ({"duration": 9e5}, "its last frame is at 0.40 s of 0.90 s"),
        ({"corrupt": 2}, "it is damaged"),
    ],
)
def test_a_film_that_is_damaged_or_cut_off_is_refused(
    tmp_path, monkeypatch, refused, changes, cause
):
    """Here in place of PyAV's."""
    given = {"start_time": 0, "duration": 5e5, **changes}
    (tmp_path / "a.mkv").touch()
    monkeypatch.setitem(sys.modules, "av", FilmStandIn(dict(enumerate(FRAMES[:5])), 10, **given))
    if cause is None:
        np.testing.assert_array_equal([*read_film(tmp_path / "a.mkv")], FRAMES[:5])
    else:
        refused(lambda: [*read_film(tmp_path / "a.mkv")], cause, "get it again")


def test_what_cannot_be_read_is_refused_in_one_line(film, tmp_path, refused):
    (tmp_path / "empty").mkdir()
    refused(lambda: [*read_film(tmp_path / "empty")], "has no frames", "name a film")
    refused(lambda: [*read_film(tmp_path / "none.mp4")], "there is no", "name a film")
    text = tmp_path / "text.mp4"
    text.write_text("no film")
    refused(lambda: [*read_film(text)], str(text), "a folder of its frames")
    clear = np.zeros((64, 128, 4), np.uint8)
    for name, pixels, cause, remedy in (
        ("0011.png", FRAMES[0, :9], "differ in size", "make them alike"),
        ("0011.png", clear, "transparent", "put them on a background"),
        ("0011.webp", FRAMES[0], "0011.webp is no .png", "convert it"),
        ("0011.jpg", FRAMES[0], "0011.jpg are not of one series", "one camera"),
        ("0003 (1).png", FRAMES[0], "0003 (1).png", "not of one series"),
        ("depth_0003.png", FRAMES[0], "depth_0003.png", "not of one series"),
    ):
        path = film / name
        Image.fromarray(pixels).save(path)
        refused(lambda: [*read_film(film)], cause, remedy)
        path.unlink()
    (film / "0011.png").write_bytes(b"\x89PNG")
    refused(lambda: [*read_film(film)], "0011.png cannot be decoded", "as PNG")
    (film / "0011.png").write_bytes(POINTER)
    refused(lambda: [*read_film(film)], "0011.png is a pointer of Git LFS", "git lfs pull")
