"""Check of the rendered frames."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from bgpo_trl.doctor.finding import Finding, first_line

if TYPE_CHECKING:
    import numpy as np

    from suites.nico.rendering import FrameRenderer


def judge_frames(still: np.ndarray, moved: np.ndarray) -> Finding:
    """Judge two frames, uint8 ``[32, 64, 3]``, between which the arm has moved."""
    import numpy as np

    colours = len(np.unique(still.reshape(-1, still.shape[-1]), axis=0))
    remedy = "try MUJOCO_GL=egl, then MUJOCO_GL=osmesa, and update the OpenGL driver"
    if colours < 20:  # a table, three objects and a hand, all shaded
        return Finding("wrong", "frame", f"blank, {colours} colours: {remedy}")
    changed = int((still != moved).any(-1).sum())
    if not changed:
        return Finding("wrong", "frame", f"stays the same when the arm moves: {remedy}")
    return Finding("ok", "frame", f"{colours} colours, {changed} pixels change as the arm moves")


def check_frame(path: Path | None = None) -> Iterator[Finding]:
    """Draw a frame before and after a movement; optionally write the first to a PNG."""
    import numpy as np

    from suites import nico
    from suites.nico.rendering import FrameRenderer

    environment = nico.load("grasp_glass", seed=0, observation="state")
    physics = environment.physics
    try:
        renderer = FrameRenderer(physics.model.ptr)
    except RuntimeError as error:
        yield Finding("wrong", "OpenGL", first_line(error))
        return
    environment.reset()
    still = renderer.render(physics.data.ptr)
    drawn_by = _driver(renderer)
    for _ in range(3):
        environment.step(np.array([1.0, 0.0, 0.0, 0.0]))
    moved = renderer.render(physics.data.ptr)
    renderer.close()
    yield Finding("ok", "OpenGL", f"{os.environ.get('MUJOCO_GL', 'default')}, {drawn_by}")
    yield judge_frames(still, moved)
    if path is not None:
        from PIL import Image

        try:
            Image.fromarray(still).resize((640, 320), Image.Resampling.NEAREST).save(path)
        except (OSError, ValueError) as error:
            told = f"cannot write {path} ({first_line(error)}): choose another for --frame"
            yield Finding("wrong", "frame", told)
            return
        yield Finding("ok", "frame", f"written to {path}")


def _driver(renderer: FrameRenderer) -> str:
    try:
        return renderer.driver()
    except Exception as error:  # Only informative; PyOpenGL raises errors of many kinds.
        return f"renderer unknown ({first_line(error)})"
