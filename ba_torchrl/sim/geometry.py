"""Positions, orientations and poses in three dimensions.

Frames are right-handed with z up, lengths are metres, angles radians, quaternions (x, y, z, w).
"""

from __future__ import annotations

import math

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Matrix = tuple[Vector, Vector, Vector]
"""Rows of a rotation matrix."""
YawPose = tuple[Vector, float]
"""Position and yaw of an upright body, or of a tool that points down."""

IDENTITY: Quaternion = (0.0, 0.0, 0.0, 1.0)


def yaw_quaternion(yaw_rad: float) -> Quaternion:
    """Return the rotation by an angle about z."""
    return (0.0, 0.0, math.sin(yaw_rad / 2), math.cos(yaw_rad / 2))


def quaternion_yaw(orientation: Quaternion) -> float:
    """Return the heading of the rotated x axis in the horizontal plane, in [-pi, pi]."""
    x, y, z, w = orientation
    return math.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))


def downward(yaw_rad: float) -> Matrix:
    """Return the rotation of a tool that points down, its fingers along x at yaw 0."""
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    return ((cos, sin, 0.0), (sin, -cos, 0.0), (0.0, 0.0, -1.0))
