"""Rendering of NICO's first-person frames at the speed the hardware allows.

Importing this module chooses the OpenGL backend, because MuJoCo and dm_control read ``MUJOCO_GL``
once, when they are first imported: on Linux EGL if its library can be loaded, else OSMesa. A value
the user has set is kept. It also sets ``LP_NUM_THREADS=0`` where unset: llvmpipe's worker threads
cost more than they give on a 64x32 frame.
"""

# MuJoCo's bindings come without stubs.
# pyright: reportAttributeAccessIssue=false

import atexit
import contextlib
import ctypes
import ctypes.util
import importlib
import os
import platform
import sys
import weakref
from collections.abc import Callable

FRAME_HEIGHT = 32  # (pixels), the paper's "64x32 RGB image"
FRAME_WIDTH = 64  # (pixels)
FRAME_CAMERA = "eyes"

_INSTALL_HINT = (
    "no OpenGL library for off-screen rendering was found: install EGL "
    "(Debian/Ubuntu: `apt-get install libegl1 libgl1-mesa-dri`) or OSMesa (`libosmesa6`)"
)


def _loadable(library: str) -> bool:
    name = ctypes.util.find_library(library)
    if name is None:
        return False
    try:
        ctypes.CDLL(name)
    except OSError:
        return False
    return True


def choose_backend(loadable: Callable[[str], bool] = _loadable) -> str | None:
    """Returns the off-screen OpenGL backend to use, or None to leave MuJoCo's own choice.

    Args:
        loadable: Tells whether a shared library of that short name can be loaded.

    Returns:
        The user's ``MUJOCO_GL`` if set; on Linux ``"egl"`` or ``"osmesa"``, whichever library is
        found first; None on other systems, where MuJoCo brings a backend of its own.

    Raises:
        RuntimeError: If Linux has neither library; the message names the packages.
    """
    chosen = os.environ.get("MUJOCO_GL")
    if chosen:
        return chosen
    if platform.system() != "Linux":
        return None
    for backend, library in (("egl", "EGL"), ("osmesa", "OSMesa")):
        if loadable(library):
            return backend
    raise RuntimeError(_INSTALL_HINT)


def _configure() -> None:
    os.environ.setdefault("LP_NUM_THREADS", "0")
    try:
        backend = choose_backend()
    except RuntimeError:
        # Physics works without OpenGL; the error belongs to whoever asks for a frame.
        backend = None
    if backend is not None and backend != os.environ.get("MUJOCO_GL"):
        os.environ["MUJOCO_GL"] = backend
        context = sys.modules.get("mujoco.rendering.classic.gl_context")
        if context is not None:  # Somebody imported MuJoCo first: have it choose again.
            importlib.reload(context)


_configure()

import mujoco  # noqa: E402
import numpy as np  # noqa: E402

# What the garbage collector would free at any moment, between the calls that draw another frame.
_abandoned: list[mujoco.Renderer] = []


def _close(renderer: mujoco.Renderer | None) -> None:
    if renderer is None:
        return
    # MuJoCo frees buffers by number in whichever context is current, be it another renderer's,
    # whose frames would be garbage from then on. Rendering makes the own context current.
    with contextlib.suppress(RuntimeError):  # It was closed before.
        renderer.render()
    renderer.close()


class FrameRenderer:
    """Renders one fixed camera of a scene, for any number of simulations of that scene.

    Keeps one OpenGL context, one scene and one camera. ``dm_control``'s ``physics.render`` builds
    a camera each call, which costs several times the frame itself. Use from one thread only.

    Args:
        model: The compiled scene. Data of every other compilation of the same XML may be rendered.
        camera: Name of the camera.
        height: Height of a frame (pixels).
        width: Width of a frame (pixels).

    Raises:
        RuntimeError: If no OpenGL context can be made; the message names the packages to install.
        ValueError: If the scene has no such camera.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        camera: str = FRAME_CAMERA,
        *,
        height: int = FRAME_HEIGHT,
        width: int = FRAME_WIDTH,
    ) -> None:
        camera_id = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, camera)
        if camera_id < 0:
            names = [model.camera(i).name for i in range(model.ncam)]
            raise ValueError(f"no camera {camera!r} in the scene; choose one of {names}")
        choose_backend()
        while _abandoned:
            _close(_abandoned.pop())
        try:
            self._renderer = mujoco.Renderer(model, height, width, max_geom=200)
        except Exception as error:  # MuJoCo's backends raise errors of many kinds.
            backend = os.environ.get("MUJOCO_GL", "default")
            raise RuntimeError(
                f"no OpenGL context from the {backend} backend ({error}); {_INSTALL_HINT}, "
                "or set MUJOCO_GL to one of egl, osmesa, glfw"
            ) from error
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._camera.fixedcamid = camera_id
        weakref.finalize(self, _abandoned.append, self._renderer).atexit = False
        # Registered after the OpenGL library's own exit handler, so that it runs before that one.
        reference = weakref.ref(self._renderer)
        atexit.register(lambda: _close(reference()))

    def render(self, data: mujoco.MjData, out: np.ndarray | None = None) -> np.ndarray:
        """Returns the frame that the camera sees.

        Args:
            data: State of the simulation.
            out: Array to write into, uint8 ``[height, width, 3]``; a new one if None.

        Returns:
            RGB frame, uint8 ``[height, width, 3]``.
        """
        self._renderer.update_scene(data, self._camera)
        return self._renderer.render(out=out)

    def close(self) -> None:
        """Frees the OpenGL context."""
        _close(self._renderer)
