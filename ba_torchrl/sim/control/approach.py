"""Approaches of the tool to the pose of a pick or place, and whether the arm reaches them."""

from __future__ import annotations

from collections.abc import Iterable

from ba_torchrl.sim.control.limits import PickPlaceLimits
from ba_torchrl.sim.geometry import Matrix, Vector
from ba_torchrl.sim.robots.base import Robot

MAX_UNCHECKED_TILT_COSINE = 0.86
"""Within 30 degrees of the vertical, neither hand nor arm can reach below the fingertips on level
ground. On a slope, contact stops the hand."""


def approach_point(
    position: Vector, rotation: Matrix, distance_m: float, *, top_down: bool = False
) -> Vector:
    """Return the point at a distance before ``position`` on the approach line.

    Args:
        position: target of the tool point, metres.
        rotation: of the tool.
        distance_m: distance from the target.
        top_down: whether the approach line is vertical, instead of the z axis of the tool.
    """
    away = (0.0, 0.0, 1.0) if top_down else tuple(-row[2] for row in rotation)
    return tuple(p + distance_m * a for p, a in zip(position, away, strict=True))


def plan_approach(
    robot: Robot,
    support_ids: Iterable[int],
    limits: PickPlaceLimits,
    end: Vector,
    rotation: Matrix,
    *,
    top_down: bool = False,
) -> list[list[float]] | None:
    """Return the arm joints at samples of an approach, the first one at its start.

    Args:
        robot: the robot.
        support_ids: PyBullet ids of the bodies that form the support surface.
        limits: distances of the samples.
        end: position of the tool point at the end of the approach, metres.
        rotation: of the tool.
        top_down: whether the approach line is vertical.

    Returns:
        Joint angles in radians; None if the approach is out of reach: a sample has no inverse
        kinematics, or hand or arm penetrate the support surface at the start or at the end.
    """
    path = []
    for distance in (limits.approach_distance_m, *limits.approach_samples_m, 0.0):
        point = approach_point(end, rotation, distance, top_down=top_down)
        joints = robot.inverse_kinematics(point, rotation, robot.joints)
        if joints is None:
            return None
        path.append(joints)
    is_steep = -rotation[2][2] > MAX_UNCHECKED_TILT_COSINE
    if not is_steep and any(robot.penetrates(support_ids, path[i]) for i in (0, -1)):
        return None
    return path
