"""Rendering of NICO's first-person frames at the speed the hardware allows."""

# MuJoCo's bindings come without stubs.
# pyright: reportAttributeAccessIssue=false

from suites import opengl  # isort: skip (before MuJoCo, which reads once what this chooses)

import atexit
import contextlib
import os
import weakref

import mujoco
import numpy as np

FRAME_HEIGHT = 32  # (pixels), the paper's "64x32 RGB image"
FRAME_WIDTH = 64  # (pixels)
FRAME_CAMERA = "eyes"

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
        if opengl.refusal:
            raise RuntimeError(opengl.refusal)
        while _abandoned:
            _close(_abandoned.pop())
        try:
            self._renderer = mujoco.Renderer(model, height, width, max_geom=200)
        except Exception as error:  # MuJoCo's backends raise errors of many kinds.
            backend = os.environ.get("MUJOCO_GL", "default")
            reason = next(iter(str(error).splitlines()), type(error).__name__)
            raise RuntimeError(
                f"no OpenGL context from the {backend} backend ({reason}): set MUJOCO_GL to egl "
                "or osmesa, or do not set it, and see that the library is there (Debian/Ubuntu: "
                "`apt-get install libegl1 libgl1-mesa-dri`, or `libosmesa6`)"
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
