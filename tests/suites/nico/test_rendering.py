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
from suites.opengl import choose_backend


@pytest.fixture
def on_linux(monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(platform, "system", lambda: "Linux")


@pytest.mark.parametrize(
    ("libraries", "backend"),
    [({"EGL", "OSMesa"}, "egl"), ({"EGL"}, "egl"), ({"OSMesa"}, "osmesa")],
)
def test_backend_is_the_first_that_can_be_loaded(on_linux, libraries, backend):
    assert choose_backend(libraries.__contains__) == backend


def test_without_any_library_one_line_says_what_to_install(on_linux):
    with pytest.raises(RuntimeError, match=r"^no OpenGL .*apt-get install libegl1.*libosmesa6.*$"):
        choose_backend(lambda _: False)


@pytest.mark.parametrize("chosen", ["egl", "osmesa", "glfw", "disabled"])
def test_the_choice_of_the_user_is_kept(on_linux, monkeypatch, chosen):
    monkeypatch.setenv("MUJOCO_GL", chosen)

    assert choose_backend(lambda _: True) == chosen


@pytest.mark.parametrize(
    ("chosen", "message"),
    [
        ("osmesa", r"^MUJOCO_GL is 'osmesa', but there is no library OSMesa: unset it.*$"),
        ("egl", r"^MUJOCO_GL is 'egl', but there is no library EGL: unset it, or install .*$"),
        (
            "EGL",
            r"^MUJOCO_GL is 'EGL', which is not an OpenGL backend: set it to egl, osmesa or .*$",
        ),
    ],
)
def test_a_choice_that_mujoco_cannot_be_imported_with_is_refused(
    on_linux, monkeypatch, chosen, message
):
    monkeypatch.setenv("MUJOCO_GL", chosen)

    with pytest.raises(RuntimeError, match=message):
        choose_backend(lambda _: False)


def test_other_systems_bring_a_backend_of_their_own(on_linux, monkeypatch):
    monkeypatch.setattr(platform, "system", lambda: "Darwin")

    assert choose_backend(lambda _: False) is None


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


@pytest.mark.parametrize(
    "imports",
    [
        "from suites import nico",
        "import mujoco\nfrom suites import nico",
        "import bgpo_trl, torchrl.envs\nfrom suites import nico",
    ],
    ids=["suite first", "mujoco first", "torchrl first"],
)
def test_a_fresh_process_renders_and_exits_cleanly(imports):
    process = run_python(imports + RENDER)

    assert (process.stdout, process.stderr, process.returncode) == ("True\n", "", 0)


def test_a_backend_that_cannot_render_is_one_line_that_says_what_to_do():
    code = f"""
from suites import nico
try:{RENDER.replace(chr(10), chr(10) + "    ")}
except RuntimeError as error:
    print(error)
"""
    process = run_python(code, MUJOCO_GL="disabled")

    line, *others = process.stdout.splitlines()
    assert not others
    assert line.startswith("no OpenGL context from the disabled backend")
    assert "set MUJOCO_GL" in line


def test_physics_works_with_a_backend_that_there_is_not_and_frames_say_why():
    code = """
from suites import nico
print(nico.load("grasp_glass", seed=0, observation="state").reset().observation.keys())
try:
    nico.load("grasp_glass", seed=0).reset()
except RuntimeError as error:
    print(error)
"""
    process = run_python(code, MUJOCO_GL="vulkan")

    observed, told = process.stdout.splitlines()
    assert "privileged_state" in observed
    assert told.startswith("MUJOCO_GL is 'vulkan', which is not an OpenGL backend: set it to egl")


def test_frames_of_simulations_that_share_a_renderer_do_not_mix(physics, renderer):
    other = nico.Physics.from_xml_string(nico.scene_xml())
    with other.reset_context():
        other.named.data.qpos["green_box"][:2] = [0.45, 0.1]
    with physics.reset_context():
        pass

    first, second = renderer.render(physics.data.ptr), renderer.render(other.data.ptr)

    assert (first != second).any()
    np.testing.assert_array_equal(renderer.render(physics.data.ptr), first)


@pytest.mark.parametrize("how", ["close", "drop", "drop in a cycle"])
def test_the_end_of_a_renderer_leaves_frames_of_others_alone(physics, renderer, how):
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
def test_a_renderer_of_one_thread_is_no_obstacle_in_another(physics, renderer, ended, abandoned):
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


def test_threads_may_draw_at_the_same_time_with_one_renderer_or_their_own(physics, renderer):
    before = renderer.render(physics.data.ptr)

    def draw(number: int) -> bool:
        own = renderer if number % 2 else FrameRenderer(physics.model.ptr)
        return all((own.render(physics.data.ptr) == before).all() for _ in range(20))

    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(draw, range(8)))


def test_what_draws_has_a_name_in_any_thread(renderer):
    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(renderer.driver).result() == renderer.driver() != "unknown"


@pytest.mark.parametrize(
    "code",
    [
        """
import threading, time
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
""",
        """
stock = nico.load("grasp_glass", seed=0, observation="state")
stock.physics.render(32, 64)
env = nico.load("grasp_glass", seed=0)
env.reset()
""",
    ],
    ids=["threads", "dm_control renders, too"],
)
def test_a_process_with_renderers_ends_without_a_word(code):
    process = run_python("from suites import nico\n" + code)

    assert (process.stdout, process.stderr, process.returncode) == ("", "", 0)


def test_a_renderer_can_be_closed_twice(physics):
    renderer = FrameRenderer(physics.model.ptr)
    renderer.close()
    renderer.close()


def test_frames_are_written_where_asked(physics, renderer):
    out = np.zeros((32, 64, 3), np.uint8)

    assert renderer.render(physics.data.ptr, out=out) is out
    np.testing.assert_array_equal(out, renderer.render(physics.data.ptr))


def test_size_and_camera_can_be_chosen(physics, renderer):
    room = FrameRenderer(physics.model.ptr, "room", height=48, width=80)

    frame = room.render(physics.data.ptr)
    room.close()

    assert frame.shape == (48, 80, 3)
    assert frame.std() > 10


def test_an_environment_that_is_closed_leaves_a_shared_renderer_alone(load):
    env = load("grasp_glass", seed=0)
    own = nico.load("grasp_glass", seed=0)
    first = own.reset().observation["pixels"]

    for _ in range(2):
        env.close()
        own.close()

    np.testing.assert_array_equal(env.reset().observation["pixels"], first)
    assert own.reset().first()  # With a renderer anew.


def test_an_unknown_camera_is_refused(physics):
    with pytest.raises(ValueError, match=r"^no camera 'nose' in the scene; choose one of .*'eyes'"):
        FrameRenderer(physics.model.ptr, "nose")


def test_images_of_dm_control_are_the_same_beside_our_frames():
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

    assert (process.stdout, process.stderr) == ("True True True True\n", "")
