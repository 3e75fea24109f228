"""Choice of the OpenGL backend, and frames."""

import gc
import os
import platform
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from suites import nico
from suites.nico.rendering import FrameRenderer
from suites.opengl import choose_backend, explain


@pytest.mark.parametrize(
    ("chosen", "screen", "libraries", "expected"),
    [
        ("", "", {"EGL", "OSMesa"}, "egl"),
        ("", "", {"OSMesa"}, "osmesa"),
        ("", "", set(), "apt-get install libegl1"),
        ("osmesa", "", {"EGL", "OSMesa"}, "osmesa"),
        ("osmesa", "", {"EGL"}, "no library OSMesa: unset it"),
        ("glfw", ":0", set(), "glfw"),
        ("glfw", "", {"EGL"}, "needs a screen"),
        ("EGL", "", {"EGL"}, "set it to egl"),
        ("off", "", {"EGL"}, "disables rendering"),
    ],
)
def test_the_backend_is_that_of_the_user_or_the_first_that_can_be_loaded(
    monkeypatch, chosen, screen, libraries, expected
):
    monkeypatch.setattr(platform, "system", lambda: "Linux")
    for name, value in (("MUJOCO_GL", chosen), ("DISPLAY", screen), ("WAYLAND_DISPLAY", "")):
        monkeypatch.setenv(name, value)
    if " " not in expected:
        assert choose_backend(libraries.__contains__) == expected
        monkeypatch.setattr(platform, "system", lambda: "Darwin")
        assert choose_backend(lambda _: False) == (chosen or None)
        return
    with pytest.raises(RuntimeError, match=expected):
        choose_backend(libraries.__contains__)


@pytest.mark.parametrize(
    ("platform", "remedy"), [("glx", "unset PYOPENGL_PLATFORM"), ("egl", "libgl1-mesa-dri")]
)
def test_a_backend_that_fails_is_explained_in_one_line(monkeypatch, platform, remedy):
    monkeypatch.delenv("MUJOCO_EGL_DEVICE_ID", raising=False)
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setenv("PYOPENGL_PLATFORM", platform)
    line = explain(ImportError("no display.\nand a trace"))
    assert line.startswith("no OpenGL context from the egl backend (no display): ")
    assert remedy in line


def run_python(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    clean = {key: value for key, value in os.environ.items() if key != "MUJOCO_GL"}
    return subprocess.run(
        [sys.executable, "-W", "error::UserWarning", "-c", code],
        env={**clean, **environment},
        capture_output=True,
        text=True,
        timeout=120,
    )


RENDER = """
nico.load("grasp_glass", seed=1).reset()  # dropped at once
env = nico.load("grasp_glass", seed=0)
print(env.reset().observation["pixels"].std() > 20)
"""


@pytest.mark.parametrize("first", ["", "import mujoco, bgpo_trl, torchrl.envs\n"])
def test_a_fresh_process_renders_whatever_it_imports_first(first):
    process = run_python(first + "from suites import nico\n" + RENDER)
    assert (process.stdout, process.stderr, process.returncode) == ("True\n", "", 0)


@pytest.mark.parametrize(
    ("environment", "remedy"),
    [
        ({"MUJOCO_GL": "egl", "MUJOCO_EGL_DEVICE_ID": "99"}, "unset MUJOCO_EGL_DEVICE_ID"),
        ({"MUJOCO_GL": "glfw", "DISPLAY": ":9876"}, "set MUJOCO_GL to egl"),
    ],
    ids=["no such device", "no such screen"],
)
def test_without_a_working_backend_physics_works_and_frames_are_refused(environment, remedy):
    code = """
from suites import nico
print(*nico.load("grasp_glass", seed=0, observation="state").reset().observation)
for _ in range(2):
    try:
        nico.load("grasp_glass", seed=0).reset()
    except RuntimeError as error:
        print(error)
"""
    process = run_python(code, **environment)
    observed, line, again = process.stdout.splitlines()
    assert observed == "privileged_state"
    assert remedy in line
    assert again == line
    assert (process.stderr, process.returncode) == ("", 0)


@pytest.mark.parametrize("how", ["close", "drop", "drop in a cycle"])
def test_closing_a_renderer_changes_no_frames_of_others(physics, renderer, how):
    before = renderer.render(physics.data.ptr)
    other = FrameRenderer(physics.model.ptr, "room")
    other.render(physics.data.ptr)
    renderer.render(physics.data.ptr)  # Its context is current now.
    if how == "close":
        other.close()
    elif how == "drop in a cycle":
        other.cycle = other
    del other
    gc.collect()
    np.testing.assert_array_equal(renderer.render(physics.data.ptr), before)
    FrameRenderer(physics.model.ptr).close()  # Frees what was dropped.
    np.testing.assert_array_equal(renderer.render(physics.data.ptr), before)


@pytest.mark.parametrize("ended", [False, True], ids=["living thread", "dead thread"])
@pytest.mark.parametrize("abandoned", [False, True], ids=["in use", "abandoned"])
def test_a_renderer_of_another_thread_changes_no_frames(physics, renderer, ended, abandoned):
    before = renderer.render(physics.data.ptr)
    with ThreadPoolExecutor(1) as pool:
        elsewhere = pool.submit(FrameRenderer, physics.model.ptr).result()
        pool.submit(elsewhere.render, physics.data.ptr).result()
        if ended:
            pool.shutdown()
        if abandoned:
            del elsewhere
        here = FrameRenderer(physics.model.ptr)
        np.testing.assert_array_equal(here.render(physics.data.ptr), before)
        if not abandoned:
            np.testing.assert_array_equal(elsewhere.render(physics.data.ptr), before)
            elsewhere.close()
        here.close()
    np.testing.assert_array_equal(renderer.render(physics.data.ptr), before)


def test_a_process_with_renderers_of_threads_ends_silently():
    code = """
import threading, time
from suites import nico
def draw(kept):
    env = nico.load("grasp_glass", seed=0)
    for _ in range(3):
        env.reset()
    kept.append(env)
def draw_on(physics):
    renderer = nico.rendering.FrameRenderer(physics.model.ptr)
    while True:
        renderer.render(physics.data.ptr)
kept = []
thread = threading.Thread(target=draw, args=(kept,))
thread.start()
thread.join()
threading.Thread(target=draw_on, args=(kept[0].physics,), daemon=True).start()
time.sleep(0.5)
"""
    process = run_python(code)
    assert (process.stdout, process.stderr, process.returncode) == ("", "", 0)


def test_size_and_camera_can_be_chosen(physics):
    room = FrameRenderer(physics.model.ptr, "room", height=48, width=80)
    frame = room.render(physics.data.ptr)
    room.close()
    room.close()  # a second time is no error
    assert frame.shape == (48, 80, 3)
    assert frame.std() > 10
    with pytest.raises(ValueError, match="no camera 'nose'"):
        FrameRenderer(physics.model.ptr, "nose")


def test_closing_an_environment_keeps_a_shared_renderer_open(load):
    env = load("grasp_glass", seed=0)
    own = nico.load("grasp_glass", seed=0)
    first = own.reset().observation["pixels"]
    for _ in range(2):
        env.close()
        own.close()
    np.testing.assert_array_equal(env.reset().observation["pixels"], first)
    assert own.reset().first()  # With a renderer anew.


def test_renderers_change_no_images_of_dm_control():
    code = """
from dm_control import suite
from suites import nico
from suites.nico.rendering import FrameRenderer

other = suite.load("cartpole", "balance", task_kwargs={"random": 0})
other.reset()
expected = other.physics.render(24, 32)
env = nico.load("grasp_glass", seed=0)
same = lambda: bool((other.physics.render(24, 32) == expected).all())
made = same()
env.reset()
drawn = same()
renderer = FrameRenderer(env.physics.model.ptr)
renderer.render(env.physics.data.ptr)
same()
renderer.close()
print(expected.std() > 10, made, drawn, same())
"""
    process = run_python(code)

    assert (process.stdout, process.stderr, process.returncode) == ("True True True True\n", "", 0)


# ---- frames of other sizes than the paper's


def middle_of_glass(frame: np.ndarray) -> float:
    """Return the horizontal position of the glass in a frame, from 0 (left) to 1 (right)."""
    red, green, blue = np.moveaxis(frame.astype(int), -1, 0)
    return np.nonzero((red > 2 * green) & (red > 2 * blue))[1].mean() / frame.shape[1]


@pytest.mark.parametrize("frame_size", [(84, 84), [48, 32], (np.int64(100), 80)])
def test_frames_of_any_size_show_all_of_the_table(load, frame_size):
    env = nico.load("grasp_glass", seed=0, frame_size=frame_size)
    spec = env.observation_spec()["pixels"]
    pixels = env.reset().observation["pixels"]
    env.close()
    assert spec.shape == (*frame_size, 3)
    spec.validate(pixels)
    paper = load("grasp_glass", seed=0).reset().observation["pixels"]
    assert middle_of_glass(pixels) == pytest.approx(middle_of_glass(paper), abs=0.02)


def test_sizes_that_frames_cannot_have_are_refused(renderer):
    for size in ((0, 84), (84, 641), (84,), (84, 84, 3), 84, (84.0, 84)):
        with pytest.raises(ValueError, match="frame_size"):
            nico.load("grasp_glass", frame_size=size)
    with pytest.raises(ValueError, match="frame_size"):  # but for those of the shared renderer
        nico.load("grasp_glass", frame_size=(84, 84), renderer=renderer)
