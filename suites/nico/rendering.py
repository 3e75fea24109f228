"""Fast rendering of NICO's first-person frames."""

# MuJoCo's bindings come without stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from suites import opengl  # isort: skip (before MuJoCo, which reads the choice on import)

import atexit
import contextlib
import functools
import operator
import threading
import weakref
from collections.abc import Callable, Sequence

import mujoco
import numpy as np

gl_context, dm_control_contexts = opengl.import_backends()

FRAME_HEIGHT = 32  # (pixels), the paper's "64x32 RGB image"
FRAME_WIDTH = 64  # (pixels)
FRAME_CAMERA = "eyes"

# Serializes drawing, since some OpenGL libraries do not support concurrent threads.
_turn = threading.RLock()
_all: weakref.WeakSet[mujoco.Renderer] = weakref.WeakSet()
# Deferred to a safe point, since the garbage collector could free them while a frame is drawn.
_abandoned: list[mujoco.Renderer] = []


def check_frame_size(model: mujoco.MjModel, frame_size: Sequence[int]) -> None:
    """Raise ``ValueError`` if a scene cannot render frames of that height and width (pixels)."""
    limits = (model.vis.global_.offheight, model.vis.global_.offwidth)
    try:
        height, width = map(operator.index, frame_size)
        possible = 1 <= height <= limits[0] and 1 <= width <= limits[1]
    except (TypeError, ValueError):
        possible = False
    if not possible:
        raise ValueError(
            f"frame_size is {frame_size}, but must be a height in 1..{limits[0]} and a width in "
            f"1..{limits[1]} (pixels)"
        )


@functools.cache
def _release() -> Callable[[], object]:
    """Return the call that makes no OpenGL context current in the calling thread.

    A context that is current in one thread cannot be used by another. Call this once a display
    exists.
    """
    backend = gl_context.GLContext.__module__
    if backend == "mujoco.egl":
        from mujoco import egl

        no_surface, no_context = egl.EGL.EGL_NO_SURFACE, egl.EGL.EGL_NO_CONTEXT
        nothing = (egl.EGL_DISPLAY, no_surface, no_surface, no_context)
        return functools.partial(egl.EGL.eglMakeCurrent, *nothing)
    if backend == "mujoco.osmesa":
        from mujoco import osmesa

        nothing = (None, None, osmesa.GL.GL_FLOAT, 0, 0)
        return functools.partial(osmesa.osmesa.OSMesaMakeCurrent, *nothing)
    if backend == "mujoco.glfw":
        from mujoco import glfw

        return functools.partial(glfw.glfw.make_context_current, None)  # pyright: ignore[reportArgumentType]
    return lambda: None


def _leave() -> None:
    """Make no context current in the calling thread, and update dm_control's records.

    dm_control notes which of its contexts is current in a thread, and does not make it current
    again: its next image would be black, of whatever environment.
    """
    _release()()
    thread = threading.current_thread()
    context = dm_control_contexts._CURRENT_CONTEXT_FOR_THREAD.pop(thread, None)
    dm_control_contexts._CURRENT_THREAD_FOR_CONTEXT.pop(context, None)


def _close(renderer: mujoco.Renderer) -> None:
    # MuJoCo frees buffers by number in the current context, which may be another renderer's and
    # would be corrupted. Rendering first makes this renderer's context current.
    with _turn:
        with contextlib.suppress(RuntimeError):  # already closed
            renderer.render()
        renderer.close()
        _leave()


@functools.cache
def _close_at_exit() -> None:
    """Close all contexts at the end of the process; called after creating a context."""
    if gl_context.GLContext.__module__ == "mujoco.egl":
        from mujoco import egl

        # MuJoCo and dm_control both terminate the shared display, even while the other has
        # contexts. The end of the process terminates it anyway.
        atexit.unregister(egl.EGL.eglTerminate)
    atexit.register(_close_all)


def _close_all() -> None:
    _turn.acquire()  # Never released, so that threads still drawing block instead of failing.
    for renderer in list(_all):
        _close(renderer)


class FrameRenderer:
    """Renderer of one fixed camera, for any number of simulations of a scene.

    It keeps one OpenGL context, one scene and one camera, whereas ``dm_control``'s
    ``physics.render`` builds a camera per call, at several times the cost of the frame. It may be
    used and closed from any thread; frames of all renderers are drawn one after another. A copy,
    also in another process, has a context of its own.

    The robot's camera shows the same horizontal range in narrower frames than the paper's, and more
    above and below.

    Args:
        model: The compiled scene. Data of other compilations of the same XML may be rendered too.
        camera: Name of the camera.
        height: Height of a frame (pixels).
        width: Width of a frame (pixels).

    Raises:
        RuntimeError: If no OpenGL context can be made; the message names the remedy.
        ValueError: If the scene has no such camera, or cannot render frames of that size.

    Attributes:
        model: The compiled scene whose looks are drawn, whatever simulation's data is rendered.
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
        self.frame_size = (height, width)
        check_frame_size(model, self.frame_size)
        opengl.check()
        try:
            with _turn, opengl.glfw_errors():
                while _abandoned:
                    _close(_abandoned.pop())
                self._renderer = mujoco.Renderer(model, height, width, max_geom=200)
                _all.add(self._renderer)
                _close_at_exit()
                _leave()
        except Exception as error:  # MuJoCo's backends raise many kinds of errors.
            raise RuntimeError(opengl.explain(error)) from error
        self.model, self._camera_name = model, camera
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._camera.fixedcamid = camera_id
        paper = FRAME_WIDTH / FRAME_HEIGHT
        self._taller = max(1.0, paper * height / width) if camera == FRAME_CAMERA else 1.0
        weakref.finalize(self, _abandoned.append, self._renderer).atexit = False

    def __reduce__(self) -> tuple[Callable[..., FrameRenderer], tuple[mujoco.MjModel, str]]:
        height, width = self.frame_size
        make = functools.partial(FrameRenderer, height=height, width=width)
        return make, (self.model, self._camera_name)

    def render(self, data: mujoco.MjData) -> np.ndarray:
        """Return an RGB frame of a simulation's state, uint8 ``[height, width, 3]``."""
        with _turn:
            self._renderer.update_scene(data, self._camera)
            if self._taller > 1.0:
                for camera in self._renderer.scene.camera:
                    camera.frustum_bottom *= self._taller
                    camera.frustum_top *= self._taller
            try:
                return self._renderer.render()
            finally:
                _leave()

    def close(self) -> None:
        """Free the OpenGL context."""
        _close(self._renderer)
