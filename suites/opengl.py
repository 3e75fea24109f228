"""Choice of the OpenGL backend, made by importing this module.

MuJoCo and dm_control read ``MUJOCO_GL`` once, on their first import, which TorchRL may cause, so
import this module first. On Linux, it sets ``MUJOCO_GL`` to EGL if its library can be loaded, else
to OSMesa. A value set by the user is kept, unless MuJoCo's import would fail with it; then
rendering is disabled, and `FrameRenderer` raises the reason. ``LP_NUM_THREADS`` is set to 0 if
unset, since llvmpipe's worker threads cost more than they gain on a 64x32 frame.
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
# Other values that both MuJoCo and dm_control accept on Linux; their import fails with any other.
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
    """Return the off-screen OpenGL backend to use, or ``None`` to leave MuJoCo's choice.

    Args:
        loadable: Returns whether a shared library with the given short name can be loaded.

    Returns:
        The user's ``MUJOCO_GL`` if set; on Linux ``"egl"`` or ``"osmesa"``, whichever library is
        found first; ``None`` on other systems, where MuJoCo includes a backend.

    Raises:
        RuntimeError: If Linux has neither library, or ``MUJOCO_GL`` is not a backend or lacks its
            library.
    """
    chosen = os.environ.get("MUJOCO_GL")
    if platform.system() != "Linux":
        return chosen or None
    if chosen in _OTHERS:
        return chosen
    if chosen and chosen not in _LIBRARIES:
        raise RuntimeError(
            f"MUJOCO_GL is {chosen!r}, which is not an OpenGL backend: set it to egl, osmesa or "
            "glfw, or unset it"
        )
    for backend in (chosen,) if chosen else _LIBRARIES:
        if loadable(_LIBRARIES[backend]):
            return backend
    if chosen:
        raise RuntimeError(
            f"MUJOCO_GL is {chosen!r}, but there is no library {_LIBRARIES[chosen]}: unset it, or "
            "install the library (Debian/Ubuntu: `apt-get install libegl1 libosmesa6`)"
        )
    raise RuntimeError(_INSTALL_HINT)


def _configure() -> str:
    os.environ.setdefault("LP_NUM_THREADS", "0")
    try:
        backend, refusal = choose_backend(), ""
    except RuntimeError as error:
        # Physics works without OpenGL, so the error is raised on the first rendering.
        backend, refusal = "disabled" if os.environ.get("MUJOCO_GL") else None, str(error)
    if backend is not None and backend != os.environ.get("MUJOCO_GL"):
        os.environ["MUJOCO_GL"] = backend
        context = sys.modules.get("mujoco.rendering.classic.gl_context")
        if context is not None:  # MuJoCo was imported first and must choose again.
            importlib.reload(context)
    return refusal


refusal = _configure()
"""Error message if there is no backend, else empty."""
