"""Process of the bare limit: MuJoCo and nothing else, so that it starts in a second."""

# MuJoCo's bindings come without stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import contextlib
from multiprocessing.connection import Connection

import mujoco
import numpy as np
from mujoco.rendering.classic.gl_context import GLContext

SUBSTEPS = 20


def bare_process(
    pipe: Connection,
    scene_xml: str,
    view: tuple[str, int, int],
    starts: np.ndarray,
    targets: np.ndarray,
) -> None:
    """Step a share of the simulations on request.

    Args:
        pipe: Delivers the number of the step; answered with ``None`` when the step is done.
        scene_xml: MJCF of the scene.
        view: Camera, width and height of the frames.
        starts: Full start states, ``[R, N]``.
        targets: Joint targets, ``[T, R, 6]``.
    """
    model = mujoco.MjModel.from_xml_string(scene_xml)
    datas = [mujoco.MjData(model) for _ in starts]
    context = GLContext(640, 480)
    context.make_current()
    scene, option = mujoco.MjvScene(model, 200), mujoco.MjvOption()
    renderer = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, renderer)
    name, width, height = view
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
    camera.fixedcamid = model.camera(name).id
    area = mujoco.MjrRect(0, 0, width, height)
    frame = np.empty((height, width, 3), np.uint8)
    everything = mujoco.mjtCatBit.mjCAT_ALL.value
    with contextlib.suppress(EOFError):  # raised at the end of the measurement
        while True:
            number = pipe.recv()
            for data, start, target in zip(datas, starts, targets[number], strict=True):
                if number == 0:
                    mujoco.mj_setState(model, data, start, mujoco.mjtState.mjSTATE_INTEGRATION)
                data.ctrl[:] = target
                mujoco.mj_step(model, data, SUBSTEPS)
                mujoco.mjv_updateScene(model, data, option, None, camera, everything, scene)
                mujoco.mjr_render(area, scene, renderer)
                mujoco.mjr_readPixels(frame, None, area, renderer)
            pipe.send(None)
