"""Choice of the OpenGL backend, made by importing this module.

MuJoCo and dm_control read ``MUJOCO_GL`` once, on their first import, which TorchRL may cause, so
import this module first. On Linux, it sets ``MUJOCO_GL`` to EGL if its library can be loaded, else
to OSMesa. A value set by the user is kept, unless MuJoCo's import would fail with it; then
rendering is disabled, and `FrameRenderer` raises the reason. So it is if the backend itself cannot
be imported, for want of a driver or a screen (`import_backends`). ``LP_NUM_THREADS`` is set to 0 if
unset, since llvmpipe's worker threads cost more than they gain on a 64x32 frame.
"""

import contextlib
import ctypes
import ctypes.util
import importlib
import os
import platform
import sys
import warnings
from collections.abc import Callable, Iterator
from types import ModuleType

_INSTALL_HINT = (
    "no OpenGL library for off-screen rendering was found: install EGL "
    "(Debian/Ubuntu: `apt-get install libegl1 libgl1-mesa-dri`) or OSMesa (`libosmesa6`)"
)

_LIBRARIES = {"egl": "EGL", "osmesa": "OSMesa"}
# Other values that both MuJoCo and dm_control accept on Linux; their import fails with any other.
_GLFW = ("glfw", "on", "enable", "enabled", "true", "1")
_OFF = ("off", "disable", "disabled", "false", "0")


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
        RuntimeError: If Linux has neither library, or ``MUJOCO_GL`` is not a backend, or lacks its
            library or screen, or disables rendering.
    """
    chosen = os.environ.get("MUJOCO_GL")
    if platform.system() != "Linux":
        return chosen or None
    if chosen in _OFF:
        raise RuntimeError(
            f"MUJOCO_GL is {chosen!r}, which disables rendering: set it to egl or osmesa, or unset "
            "it"
        )
    if chosen in _GLFW:
        if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
            return chosen
        raise RuntimeError(
            f"MUJOCO_GL is {chosen!r}, which needs a screen, and DISPLAY is not set: set MUJOCO_GL "
            "to egl, or unset it"
        )
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


def check() -> None:
    """Raise ``RuntimeError`` if there is no backend that can be imported."""
    if refusal:
        raise RuntimeError(refusal)


def import_backends() -> tuple[ModuleType, ModuleType]:
    """Import the OpenGL backends of MuJoCo and dm_control; disable rendering if they raise.

    Both libraries look for a driver, a device or a screen on import, and do not work at all without
    one, unless rendering is disabled.

    Returns:
        MuJoCo's module of its context, and dm_control's of its contexts.
    """
    global refusal
    try:
        with glfw_errors():
            return _import_backends()
    except Exception as error:  # They raise many kinds of errors.
        refusal = refusal or explain(error)
    chosen = os.environ.pop("MUJOCO_GL", None)
    os.environ["MUJOCO_GL"] = "disabled"
    try:
        return _import_backends()
    finally:  # Child processes find the cause themselves, and name what the user has set.
        del os.environ["MUJOCO_GL"]
        if chosen is not None:
            os.environ["MUJOCO_GL"] = chosen


def _import_backends() -> tuple[ModuleType, ModuleType]:
    context = importlib.import_module("mujoco.rendering.classic.gl_context")
    importlib.import_module("dm_control._render")  # first, as its parts outlive its failed import
    return context, importlib.import_module("dm_control._render.base")


@contextlib.contextmanager
def glfw_errors() -> Iterator[None]:
    """Raise GLFW's errors within the block, which it only reports as warnings.

    MuJoCo would go on without a context, and abort the process at the second attempt.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("error", module="glfw")
        yield


def explain(error: Exception) -> str:
    """Return in one line why a backend failed, and what to do."""
    backend = os.environ.get("MUJOCO_GL", "default")
    # dm_control raises an ImportError without a message from GLFW's error.
    text = str(error) or str(error.__cause__ or type(error).__name__)
    reason = text.splitlines()[0].rstrip(".")
    if os.environ.get("MUJOCO_EGL_DEVICE_ID") and backend == "egl":
        remedy = "unset MUJOCO_EGL_DEVICE_ID, or set it to the number of a GPU of this machine"
    elif backend in _LIBRARIES and os.environ.get("PYOPENGL_PLATFORM", backend) != backend:
        remedy = "unset PYOPENGL_PLATFORM"
    else:
        remedy = (
            "set MUJOCO_GL to egl or osmesa, or unset it, and check that library and driver are "
            "installed (Debian/Ubuntu: `apt-get install libegl1 libgl1-mesa-dri`, or `libosmesa6`)"
        )
    return f"no OpenGL context from the {backend} backend ({reason}): {remedy}"


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
"""Error message if there is no backend that can be imported, else empty."""
