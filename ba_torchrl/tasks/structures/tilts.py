"""Pieces on slopes: the frames of the sides on which they lie, tilted tools and releases."""

from __future__ import annotations

import math

from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.geometry import (
    Pose,
    Quaternion,
    axes_quaternion,
    cross,
    dot,
    perpendicular,
    quaternion_matrix,
    quaternion_product,
    surface_quaternion,
)
from ba_torchrl.tasks.structures.blueprint import Piece

TILT_SHARES = (1.0, 0.5, 0.0)
"""Approach directions that are compared: 1 along the normal of the piece's side, 0 as close to the
vertical as the closing axis allows."""


def resting_frame(piece: Piece, body: Body) -> Quaternion:
    """Return the orientation of the frame of the side on which a body lies.

    Its z axis is the direction of `Piece.up` closest to the vertical. For a body that lies level,
    the heading of its x axis is `Piece.yaw_rad`.
    """
    rows = quaternion_matrix(body.pose.orientation)
    up = max(piece.up, key=lambda up: sum(d * u for d, u in zip(rows[2], up, strict=True)))
    z_axis = tuple(sum(r * u for r, u in zip(row, up, strict=True)) for row in rows)
    x_axis, y_axis, _ = zip(*rows, strict=True)
    if abs(y_axis[2]) <= abs(x_axis[2]):
        x_axis = cross(y_axis, z_axis)
    return axes_quaternion(x_axis, z_axis)


def in_resting_frame(piece: Piece, body: Body) -> Quaternion:
    """Return the orientation of a body relative to the frame of the side on which it lies."""
    x, y, z, w = resting_frame(piece, body)
    return quaternion_product((-x, -y, -z, w), body.pose.orientation)


def release_pose(piece: Piece, body: Body, origin: Pose, yaw_rad: float) -> Pose:
    """Return the pose at which a body rests on its support.

    Args:
        origin: a frame at its origin whose z axis is the normal of the support.
        yaw_rad: yaw of the frame of the side on which it lies.
    """
    normal = tuple(row[2] for row in quaternion_matrix(origin.orientation))
    frame = surface_quaternion(normal, yaw_rad)
    return Pose(origin.position, quaternion_product(frame, in_resting_frame(piece, body)))


def tilted_tools(piece: Piece, body: Body) -> list[Quaternion]:
    """Return the orientations of the tool at which the fingers close on a tilted body."""
    rows = quaternion_matrix(resting_frame(piece, body))
    down = tuple(-row[2] for row in rows)
    tools = []
    for share in TILT_SHARES:
        for yaw in piece.grasp_yaws_rad:
            closing = tuple(dot(row, (math.cos(yaw), math.sin(yaw), 0.0)) for row in rows)
            vertical = perpendicular((0.0, 0.0, -1.0), closing)
            between = tuple(
                share * d + (1 - share) * v for d, v in zip(down, vertical, strict=True)
            )
            tools.append(axes_quaternion(closing, perpendicular(between, closing)))
    return tools
