"""Rotations, poses (SE(3)) and planar frames (SE(2)).

Frames are right-handed with z up. Lengths are in metres, angles in radians, quaternions in the
order (x, y, z, w).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import numpy as np
import pybullet

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Matrix = tuple[Vector, Vector, Vector]
"""The rows of a rotation matrix."""
YawPose = tuple[Vector, float]
"""Position and yaw of an upright body or of a tool that points straight down."""

Coordinate = TypeVar("Coordinate", float, np.ndarray)

ORIGIN: Vector = (0.0, 0.0, 0.0)
IDENTITY: Quaternion = (0.0, 0.0, 0.0, 1.0)


# -- rotations ---------------------------------------------------------------------------------


def yaw_quaternion(yaw_rad: float) -> Quaternion:
    """Return the rotation by an angle about the z axis."""
    return (0.0, 0.0, math.sin(yaw_rad / 2), math.cos(yaw_rad / 2))


def quaternion_yaw(orientation: Quaternion) -> float:
    """Return the heading of the rotated x axis in the horizontal plane, in [-pi, pi]."""
    x, y, z, w = orientation
    return math.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))


def quaternion_tilt(orientation: Quaternion) -> float:
    """Return the angle between the rotated z axis and the vertical, in [0, pi]."""
    x, y, _, _ = orientation
    return math.acos(min(max(1 - 2 * (x * x + y * y), -1.0), 1.0))


def quaternion_matrix(orientation: Quaternion) -> Matrix:
    """Return the rows of a unit quaternion's rotation matrix."""
    m = pybullet.getMatrixFromQuaternion(orientation)
    return m[:3], m[3:6], m[6:]


def rotation_array(orientation: Quaternion) -> np.ndarray:
    """Return the rotation matrix of a unit quaternion, [3, 3] float64 array."""
    return np.reshape(pybullet.getMatrixFromQuaternion(orientation), (3, 3))


def euler_matrix(rz_rad: float, ry_rad: float, rx_rad: float) -> Matrix:
    """Return the rows of the rotation matrix Rz(rz) Ry(ry) Rx(rx)."""
    cz, sz = math.cos(rz_rad), math.sin(rz_rad)
    cy, sy = math.cos(ry_rad), math.sin(ry_rad)
    cx, sx = math.cos(rx_rad), math.sin(rx_rad)
    return (
        (cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx),
        (sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx),
        (-sy, cy * sx, cy * cx),
    )


def quaternion_product(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return the rotation by ``b`` followed by the rotation by ``a``."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by + ay * bw + az * bx - ax * bz,
        aw * bz + az * bw + ax * by - ay * bx,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def matrix_quaternion(rows: Matrix) -> Quaternion:
    """Return the unit quaternion of a rotation matrix, given by its rows."""
    (m00, m01, m02), (m10, m11, m12), (m20, m21, m22) = rows
    # four times the squares of the components; the largest one is a safe divisor
    squares = (1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22, 1 + m00 + m11 + m22)
    largest = squares.index(max(squares))
    products = (
        (squares[0], m01 + m10, m02 + m20, m21 - m12),
        (m01 + m10, squares[1], m12 + m21, m02 - m20),
        (m02 + m20, m12 + m21, squares[2], m10 - m01),
        (m21 - m12, m02 - m20, m10 - m01, squares[3]),
    )[largest]
    scale = 0.5 / math.sqrt(squares[largest])
    x, y, z, w = (scale * product for product in products)
    return x, y, z, w


def surface_quaternion(normal: Vector, yaw_rad: float = 0.0) -> Quaternion:
    """Return the orientation of a frame on a surface with a unit normal that is not horizontal.

    Its z axis is the normal, and ``yaw_rad`` the heading of its x axis in the horizontal plane.
    """
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    x_axis = perpendicular((cos, sin, -(cos * normal[0] + sin * normal[1]) / normal[2]), normal)
    return axes_quaternion(x_axis, normal)


def axes_quaternion(x_axis: Vector, z_axis: Vector) -> Quaternion:
    """Return the orientation of the frame with two perpendicular unit vectors as axes."""
    y_axis = cross(z_axis, x_axis)
    return matrix_quaternion(tuple(zip(x_axis, y_axis, z_axis, strict=True)))


# -- tool frames: z is the approach direction, the fingers open along x -------------------------


def downward(yaw_rad: float) -> Matrix:
    """Return the rotation of a tool that points straight down.

    Its fingers open along a line with heading ``yaw_rad``; 0 is the world's x axis.
    """
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    return ((cos, sin, 0.0), (sin, -cos, 0.0), (0.0, 0.0, -1.0))


def downward_quaternion(yaw_rad: float) -> Quaternion:
    """Return the quaternion of `downward`."""
    return (math.cos(yaw_rad / 2), math.sin(yaw_rad / 2), 0.0, 0.0)


def tool_rotation(rz_rad: float, ry_rad: float = 0.0, rx_rad: float = 0.0) -> Matrix:
    """Return the rotation Rz(rz) Ry(ry) Rx(rx) `downward(0)`: straight down at zero angles."""
    return tuple((x, -y, -z) for x, y, z in euler_matrix(rz_rad, ry_rad, rx_rad))


def tool_angles(orientation: Quaternion) -> Vector:
    """Return the angles rz, ry and rx of `tool_rotation` for an orientation of the tool.

    rz and rx are in [-pi, pi], ry in [-pi/2, pi/2].
    """
    (m00, _, _), (m10, _, _), (m20, m21, m22) = quaternion_matrix(orientation)
    return math.atan2(m10, m00), math.asin(min(max(-m20, -1.0), 1.0)), math.atan2(-m21, -m22)


# -- poses -------------------------------------------------------------------------------------


class Pose(NamedTuple):
    """The pose of a frame relative to an outer frame, an element of SE(3)."""

    position: Vector
    orientation: Quaternion = IDENTITY

    def compose(self, inner: Pose) -> Pose:
        """Return the pose ``inner`` of this frame relative to the outer frame."""
        rows = quaternion_matrix(self.orientation)
        position = tuple(
            p + dot(row, inner.position) for p, row in zip(self.position, rows, strict=True)
        )
        return Pose(position, quaternion_product(self.orientation, inner.orientation))

    def inverse(self) -> Pose:
        """Return the pose of the outer frame relative to this frame."""
        columns = zip(*quaternion_matrix(self.orientation), strict=True)
        x, y, z, w = self.orientation
        return Pose(tuple(-dot(column, self.position) for column in columns), (-x, -y, -z, w))

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Transform points [..., 3] from this frame to the outer frame."""
        return points @ rotation_array(self.orientation).T + self.position

    def rotate(self, vectors: np.ndarray) -> np.ndarray:
        """Rotate direction vectors [..., 3] from this frame to the outer frame."""
        return vectors @ rotation_array(self.orientation).T

    def moved_to(self, position: Vector, turn_rad: float = 0.0) -> Pose:
        """Return the pose at another position, rotated about the outer frame's z axis."""
        return Pose(position, quaternion_product(yaw_quaternion(turn_rad), self.orientation))

    @property
    def yaw_rad(self) -> float:
        """Heading of the x axis in the horizontal plane, in [-pi, pi]."""
        return quaternion_yaw(self.orientation)


def downward_pose(position: Vector, yaw_rad: float) -> Pose:
    """Return the pose of a tool that points straight down."""
    return Pose(position, downward_quaternion(yaw_rad))


def carrying_pose(tool: Pose, held: Pose, target: Pose) -> Pose:
    """Return the pose of the tool that brings the held body to a pose."""
    return target.compose(held.inverse().compose(tool))


def bullet_compose(outer: Pose, inner: Pose) -> Pose:
    """Return `outer.compose(inner)`, computed by PyBullet in single precision."""
    return Pose(*pybullet.multiplyTransforms(*outer, *inner))


def bullet_inverse(pose: Pose) -> Pose:
    """Return `pose.inverse()`, computed by PyBullet in single precision."""
    return Pose(*pybullet.invertTransform(*pose))


class PlanarFrame(NamedTuple):
    """The pose of a frame in the horizontal plane, an element of SE(2)."""

    x: float
    y: float
    yaw_rad: float

    def to_world(self, x: Coordinate, y: Coordinate) -> tuple[Coordinate, Coordinate]:
        """Transform coordinates (floats or arrays) from this frame to the world frame."""
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return self.x + cos * x - sin * y, self.y + sin * x + cos * y

    def to_local(self, x: Coordinate, y: Coordinate) -> tuple[Coordinate, Coordinate]:
        """Transform coordinates (floats or arrays) from the world frame to this frame."""
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        dx, dy = x - self.x, y - self.y
        return cos * dx + sin * dy, cos * dy - sin * dx


def dot(a: Sequence[float], b: Sequence[float]) -> float:
    """Return the scalar product of two vectors of three components."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Sequence[float], b: Sequence[float]) -> Vector:
    """Return the cross product of two vectors of three components."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def perpendicular(vector: Vector, axis: Vector) -> Vector:
    """Return the normalised component of a vector that is perpendicular to a unit vector.

    It is zero if the vectors are parallel.
    """
    along = dot(vector, axis)
    rest = tuple(v - along * a for v, a in zip(vector, axis, strict=True))
    norm = math.sqrt(dot(rest, rest)) or 1.0
    return tuple(r / norm for r in rest)
