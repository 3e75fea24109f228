"""Cameras and simplified meshes of the scene of Meta-World, on a ball instead of the robot."""

import sys

import mujoco
import numpy as np
import pytest

from bgpo_trl.experiments.command_line import import_plugin
from examples.meta_world_frames import TwoCameras, place_cameras, simplified

BALL = """
<mujoco>
  <asset>
    <mesh name="ball" builtin="sphere" params="4" scale="0.2 0.2 0.3"/>
    <mesh name="wedge" vertex="0 0 0  0.1 0 0  0 0.1 0  0 0 0.1"/>
  </asset>
  <worldbody>
    <light pos="0 0 2"/>
    <camera name="corner"/>
    <camera name="corner2"/>
    <geom type="mesh" mesh="ball" pos="0 0.7 0.17" rgba="1 0 0 1"/>
    <geom type="mesh" mesh="wedge" pos="0.2 0.5 0" rgba="0 1 0 1"/>
  </worldbody>
</mujoco>
"""


@pytest.fixture
def model():
    model = mujoco.MjModel.from_xml_string(BALL)
    place_cameras(model)
    return model


@pytest.fixture
def data(model):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


def triangles(model, name):
    """Return the corners of a mesh's faces, ``[F, 3, 3]``."""
    mesh = model.mesh(name)
    first, face = mesh.vertadr[0], mesh.faceadr[0]
    vertices = model.mesh_vert[first : first + mesh.vertnum[0]]
    return vertices[model.mesh_face[face : face + mesh.facenum[0]]]


def volume(corners):
    a, b, c = corners.transpose(1, 0, 2)
    return (np.cross(a, b) * c).sum() / 6


def test_large_meshes_become_closed_hulls_of_their_own_vertices(model):
    full, hull = (triangles(each, "ball") for each in (model, simplified(model)))

    assert len(hull) < 100 < 1_000 < len(full)
    points = {tuple(point) for point in full.reshape(-1, 3)}
    assert all(tuple(point) in points for point in hull.reshape(-1, 3))
    a, b, c = hull.transpose(1, 0, 2)
    assert ((np.cross(b - a, c - a) * a).sum(1) > 0).all()  # faces look outward
    # Only a closed surface has a volume that does not depend on the origin.
    assert volume(hull + 5) == pytest.approx(volume(hull), rel=1e-3)
    assert 0.6 < volume(hull) / volume(full) < 1


def test_small_meshes_and_the_simulated_model_stay_as_they_are(model):
    before = model.mesh_face.copy(), model.mesh_facenum.copy(), model.light_castshadow.copy()
    drawn = simplified(model)

    assert np.array_equal(triangles(drawn, "wedge"), triangles(model, "wedge"))
    after = model.mesh_face, model.mesh_facenum, model.light_castshadow
    assert all(np.array_equal(*pair) for pair in zip(before, after, strict=True))


def test_cameras_look_level_at_the_middle_of_the_table(data):
    for name, height in (("corner", 0.17 + 1.1 * np.sin(np.deg2rad(35))), ("corner2", None)):
        camera = data.camera(name)
        turn = camera.xmat.reshape(3, 3)
        assert camera.xpos - 1.1 * turn[:, 2] == pytest.approx([0, 0.7, 0.17], abs=1e-6)
        assert turn[2, 0] == pytest.approx(0, abs=1e-6)
        if height is not None:
            assert camera.xpos[2] == pytest.approx(height)


def test_a_frame_shows_both_views_of_the_simplified_scene(model, data):
    frame = TwoCameras(model).frame(data).astype(int)

    assert frame.shape == (32, 64, 3)
    for view in (frame[:, :32], frame[:, 32:]):
        red = view[..., 0] > view[..., 1] + 20
        rows, columns = np.nonzero(red)
        assert 100 < red.sum() < 600
        assert (rows.mean(), columns.mean()) == pytest.approx((15.5, 15.5), abs=1.5)


def test_without_the_package_the_scene_says_what_to_install(monkeypatch):
    monkeypatch.delitem(sys.modules, "examples.meta_world", raising=False)
    monkeypatch.setitem(sys.modules, "metaworld.env_dict", None)
    with pytest.raises(ValueError, match=r"docs/extending\.md"):
        import_plugin("examples.meta_world")
