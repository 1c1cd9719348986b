"""Grasps of pieces on slopes, and poses of the tool that release a piece parallel to a surface."""

from __future__ import annotations

import math

from ba_torchrl.actions import MAX_TILT_RAD
from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.control.pick_place import PickPlaceLimits, approach_point, plan_approach
from ba_torchrl.sim.geometry import (
    Pose,
    Quaternion,
    axes_quaternion,
    dot,
    perpendicular,
    quaternion_matrix,
    quaternion_product,
    surface_quaternion,
    tool_angles,
)
from ba_torchrl.sim.robots.base import Robot
from ba_torchrl.tasks.structures.blueprint import Piece

TILT_SHARES = (1.0, 0.5, 0.0)
"""Approach directions that are compared: 1 along the normal of the piece's side, 0 as close to the
vertical as the closing axis allows."""


def tilted_tools(piece: Piece, body: Body) -> list[Quaternion]:
    """Return the orientations of the tool at which the fingers close on a tilted body.

    Args:
        piece: the kind of piece.
        body: the body.
    """
    rows = quaternion_matrix(piece.resting_frame(body))
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


def in_resting_frame(piece: Piece, body: Body) -> Quaternion:
    """Return the orientation of a body relative to the frame of the side on which it lies."""
    x, y, z, w = piece.resting_frame(body)
    return quaternion_product((-x, -y, -z, w), body.pose.orientation)


def release_pose(piece: Piece, body: Body, origin: Pose, yaw_rad: float) -> Pose:
    """Return the pose at which a body rests on its support.

    Args:
        piece: the kind of piece.
        body: the body.
        origin: a frame at its origin whose z axis is the normal of the support.
        yaw_rad: yaw of the frame of the side on which it lies.
    """
    normal = tuple(row[2] for row in quaternion_matrix(origin.orientation))
    frame = surface_quaternion(normal, yaw_rad)
    return Pose(origin.position, quaternion_product(frame, in_resting_frame(piece, body)))


def is_reachable(
    robot: Robot, support_ids: frozenset[int], tool: Pose, clearance_m: float = 0.0
) -> bool:
    """Whether the arm reaches a pose of the tool and the approach to it.

    Both are also reached after half a turn of the tool, which the action space may add.

    Args:
        robot: the robot.
        support_ids: PyBullet ids of the bodies that form the ground.
        tool: pose of the tool.
        clearance_m: distance before the pose at which the approach ends.
    """
    if any(abs(tilt) > MAX_TILT_RAD for tilt in tool_angles(tool.orientation)[1:]):
        return False
    rotation = quaternion_matrix(tool.orientation)
    end = approach_point(tool.position, rotation, clearance_m)
    half_turn = tuple((-x, -y, z) for x, y, z in rotation)
    return all(
        plan_approach(robot, support_ids, PickPlaceLimits(), end, turned) is not None
        for turned in (rotation, half_turn)
    )
