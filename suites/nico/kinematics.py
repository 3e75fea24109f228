"""Closed-form inverse kinematics of NICO's arm: yaw, then two links in a vertical plane.

The numbers are those of ``nico.xml`` (from NICO's published URDF); a test compares them.
"""

import numpy as np

YAW_AXIS = np.array([0.0268, -0.0499])  # (m) x, y of the vertical shoulder yaw axis
PITCH_FORWARD = 0.05  # (m) pitch axis ahead of the yaw axis
PITCH_RIGHT = 0.0917  # (m) pitch axis to the right of the yaw axis
PITCH_HEIGHT = 0.7629  # (m) height of the pitch axis
UPPER_ARM = 0.176  # (m) shoulder pitch to elbow
FOREARM = 0.1265  # (m) elbow to wrist

GRIP = (0.043, 0.106)  # (m) centre of a held glass: left of the arm's plane, beyond the wrist
PALM = (0.0, 0.075)  # (m) centre of the palm


def polar(radius: float, angle: float) -> np.ndarray:
    """Return ``[x, y]`` (m) at a radius (m) and angle (rad, left positive) about the yaw axis."""
    return YAW_AXIS + radius * np.array([np.cos(angle), np.sin(angle)])


def to_polar(position: np.ndarray) -> tuple[float, float]:
    """Return radius (m) and angle (rad, left positive) of ``[x, y, ...]`` about the yaw axis."""
    x, y = np.asarray(position)[:2] - YAW_AXIS
    return float(np.hypot(x, y)), float(np.arctan2(y, x))


def inverse(position: np.ndarray, point: tuple[float, float] = GRIP) -> np.ndarray:
    """Return the joint angles that bring a point of the hand to a position, with the elbow low.

    Args:
        position: Target ``[x, y, z]`` (m). Targets out of reach are approached with a straight arm.
        point: The hand's point as (left of the arm's plane, beyond the wrist) (m).

    Returns:
        Shoulder yaw, shoulder pitch and elbow (rad), ``[3]``; zero is the hanging arm.
    """
    left, beyond = point
    lateral = left - PITCH_RIGHT
    radius, angle = to_polar(position)
    radius = max(radius, abs(lateral) + 1e-6)
    yaw = angle - np.arcsin(lateral / radius)
    forward = np.sqrt(radius**2 - lateral**2) - PITCH_FORWARD
    down = PITCH_HEIGHT - position[2]
    hand = FOREARM + beyond
    distance = np.hypot(forward, down)
    cosine = (distance**2 - UPPER_ARM**2 - hand**2) / (2 * UPPER_ARM * hand)
    elbow = np.arccos(np.clip(cosine, -1.0, 1.0))
    # The pitch is the target's angle from the hanging arm, minus the elbow's contribution.
    line = np.arctan2(forward, down)
    pitch = line - np.arctan2(hand * np.sin(elbow), UPPER_ARM + hand * np.cos(elbow))
    return np.array([yaw, pitch, elbow])
