"""The choice of the OpenGL backend, made by importing this module.

MuJoCo and dm_control read ``MUJOCO_GL`` once, when they are first imported, be it by TorchRL: so
import this before them. It sets, on Linux, EGL if its library can be loaded, else OSMesa. A value
the user has set is kept, unless MuJoCo could not be imported with it: then there are no frames, and
who asks for one is told why. It also sets ``LP_NUM_THREADS=0`` where unset: llvmpipe's worker
threads cost more than they give on a 64x32 frame.
"""

import ctypes
import ctypes.util
import importlib
import os
import platform
import sys
from collections.abc import Callable

_INSTALL_HINT = (
    "no OpenGL library for off-screen rendering was found: install EGL "
    "(Debian/Ubuntu: `apt-get install libegl1 libgl1-mesa-dri`) or OSMesa (`libosmesa6`)"
)

_LIBRARIES = {"egl": "EGL", "osmesa": "OSMesa"}
# What else both MuJoCo and dm_control know on Linux; with any other value they are not imported.
_OTHERS = ("glfw", "on", "enable", "enabled", "true", "1")
_OTHERS += ("off", "disable", "disabled", "false", "0")


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
        RuntimeError: If Linux has neither library, or not the one that the user's choice needs, or
            that is no backend; the message says what to do.
    """
    chosen = os.environ.get("MUJOCO_GL")
    if platform.system() != "Linux":
        return chosen or None
    if chosen in _OTHERS:
        return chosen
    if chosen and chosen not in _LIBRARIES:
        raise RuntimeError(
            f"MUJOCO_GL is {chosen!r}, which is no OpenGL backend: set it to egl, osmesa or glfw, "
            "or do not set it"
        )
    for backend in (chosen,) if chosen else _LIBRARIES:
        if loadable(_LIBRARIES[backend]):
            return backend
    if chosen:
        raise RuntimeError(
            f"MUJOCO_GL is {chosen!r}, but there is no library {_LIBRARIES[chosen]}: do not set "
            "it, or install the library (Debian/Ubuntu: `apt-get install libegl1 libosmesa6`)"
        )
    raise RuntimeError(_INSTALL_HINT)


def _configure() -> str:
    os.environ.setdefault("LP_NUM_THREADS", "0")
    try:
        backend, refusal = choose_backend(), ""
    except RuntimeError as error:
        # Physics works without OpenGL; the error belongs to whoever asks for a frame.
        backend, refusal = "disabled" if os.environ.get("MUJOCO_GL") else None, str(error)
    if backend is not None and backend != os.environ.get("MUJOCO_GL"):
        os.environ["MUJOCO_GL"] = backend
        context = sys.modules.get("mujoco.rendering.classic.gl_context")
        if context is not None:  # Somebody imported MuJoCo first: have it choose again.
            importlib.reload(context)
    return refusal


refusal = _configure()
"""Why there is no backend; empty where there is one."""
