"""Fast frames of Meta-World's scenes: two views of 32 x 32 pixels, side by side."""

from __future__ import annotations

from copy import copy

from suites.nico.rendering import FrameRenderer  # isort: skip (before MuJoCo)

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

FRAME_SHAPE = (32, 64)  # height and width (pixels)
_LOOK_AT, _DISTANCE, _FIELD = np.array([0.0, 0.7, 0.17]), 1.1, 40.0  # m, m, degrees
# Azimuth and elevation (degrees) of the views, in place of two of Meta-World's cameras.
_CAMERAS = {"corner": (135.0, -35.0), "corner2": (180.0, -15.0)}
_MANY_FACES, _DIRECTIONS = 1_000, 40


def place_cameras(model: mujoco.MjModel) -> None:
    """Put the two cameras in their places: one looks over the objects, one from the side."""
    for name, (azimuth, elevation) in _CAMERAS.items():
        # MuJoCo's cameras look along their -z; at azimuth 0 and elevation 0, along x.
        turn = Rotation.from_euler("ZX", [azimuth - 90, elevation + 90], degrees=True)
        camera = model.camera(name)
        camera.pos, camera.fovy = _LOOK_AT + _DISTANCE * turn.apply([0, 0, 1]), _FIELD
        camera.quat = turn.as_quat(scalar_first=True)


def simplified(model: mujoco.MjModel, samples: int = 0) -> mujoco.MjModel:
    """Return a copy to draw, without shadows and mirrors, and with simple hulls for large meshes.

    A frame takes a hundredth of the time.

    Args:
        model: The model.
        samples: Points of each pixel that are drawn and averaged; 0 for its middle alone.
    """
    model = copy(model)
    model.light_castshadow[:] = model.mat_reflectance[:] = 0
    model.vis.quality.shadowsize, model.vis.quality.offsamples = 0, samples
    directions = np.random.default_rng(0).standard_normal((_DIRECTIONS, 3))
    for mesh in np.flatnonzero(model.mesh_facenum > _MANY_FACES):
        first, face = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
        vertices = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
        outer = np.unique((vertices @ directions.T).argmax(0))
        hull = ConvexHull(vertices[outer])
        corners = outer[hull.simplices]
        a, b, c = vertices[corners].transpose(1, 0, 2)
        inward = (np.cross(b - a, c - a) * hull.equations[:, :3]).sum(1) < 0
        corners[inward] = corners[inward, ::-1]
        faces = slice(face, face + len(corners))
        model.mesh_face[faces] = model.mesh_facenormal[faces] = corners
        model.mesh_facenum[mesh] = len(corners)
    return model


class TwoCameras:
    """Renderers of the two views, with an OpenGL context each.

    Args:
        model: A model whose cameras are in their places.
        samples: As for `simplified`.
    """

    def __init__(self, model: mujoco.MjModel, samples: int = 0) -> None:
        model, (height, width) = simplified(model, samples), FRAME_SHAPE
        self.renderers = [
            FrameRenderer(model, camera, height=height, width=width // 2) for camera in _CAMERAS
        ]

    def frame(self, data: mujoco.MjData) -> NDArray[np.uint8]:
        """Return both views, uint8 ``[32, 64, 3]``."""
        return np.hstack([renderer.render(data) for renderer in self.renderers])
