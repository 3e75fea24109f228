"""Closed-form kinematics against the simulation."""

import math

import numpy as np
import pytest

from suites.nico import kinematics
from suites.nico.physics import OBJECT_HALF_HEIGHT, TABLE_HEIGHT, Physics


def set_arm(physics: Physics, arm: np.ndarray) -> None:
    physics.data.qpos[:3] = arm
    physics.forward()


@pytest.mark.parametrize(("site", "point"), [("grip", kinematics.GRIP), ("palm", kinematics.PALM)])
def test_inverse_kinematics_agrees_with_the_simulation(physics, site, point):
    random = np.random.default_rng(0)
    for _ in range(200):
        # Ahead of the robot and above the table, clear of full stretch.
        place = kinematics.polar(random.uniform(0.25, 0.42), random.uniform(-0.7, 0.7))
        target = np.append(place, TABLE_HEIGHT + random.uniform(0.02, 0.15))
        set_arm(physics, kinematics.inverse(target, point))
        np.testing.assert_allclose(physics.named.data.site_xpos[site], target, atol=1e-9)


def test_targets_out_of_reach_are_approached_with_a_straight_arm(physics):
    target = np.array([1.5, 0.0, TABLE_HEIGHT])
    arm = kinematics.inverse(target)
    assert arm[2] == 0.0
    set_arm(physics, arm)
    hand, yaw = physics.grip_position(), arm[0]
    shoulder = kinematics.YAW_AXIS + kinematics.PITCH_FORWARD * np.array([np.cos(yaw), np.sin(yaw)])
    reach = kinematics.UPPER_ARM + kinematics.FOREARM + kinematics.GRIP[1]
    in_plane = math.hypot(hand[2] - kinematics.PITCH_HEIGHT, *(hand[:2] - shoulder))
    lateral = kinematics.GRIP[0] - kinematics.PITCH_RIGHT
    assert in_plane == pytest.approx(math.hypot(reach, lateral), abs=1e-9)


def test_heights_agree_with_the_scene(physics):
    size = physics.named.model.geom_size
    top = physics.named.model.body_pos["table"][2] + size["table"][2]
    assert top == pytest.approx(TABLE_HEIGHT)
    for name, axis in (("glass", 1), ("green_box", 2), ("white_box", 2)):
        assert size[name][axis] == OBJECT_HALF_HEIGHT[name]


def test_polar_coordinates_are_about_the_yaw_axis():
    np.testing.assert_allclose(kinematics.polar(0.4, np.pi / 2), [0.0268, -0.0499 + 0.4])
    for angle in (-2.0, 0.0, 1.3):
        assert kinematics.to_polar(kinematics.polar(0.3, angle)) == pytest.approx((0.3, angle))
