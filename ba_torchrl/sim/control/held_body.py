"""The pose of a held body relative to the tool."""

import math
from itertools import product
from typing import NamedTuple

from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.geometry import Pose, bullet_compose, bullet_inverse
from ba_torchrl.sim.robots.base import DISTANT_M, Robot

TILT_RAD = 0.001
"""Angle about each axis at which a corner of a face is the deepest point in the opposite face."""
_TILTS = [
    Pose((0.0, 0.0, 0.0), (0.0, a * TILT_RAD / 2, b * TILT_RAD / 2, 1.0))
    for a, b in product((1, -1), repeat=2)
]
"""Rotations of the tool frame about the axes perpendicular to the closing axis."""


class FirmGrasp(NamedTuple):
    """A grasp in which a simulated motion did not move the body."""

    body: Body
    pose: Pose
    """Pose of the body in the tool frame at the end of that motion."""


def pose_in_tool_frame(robot: Robot, body: Body) -> Pose:
    """Return the pose of a body in the tool frame."""
    return bullet_compose(bullet_inverse(robot.tool_frame()), body.pose)


def place_in_tool_frame(robot: Robot, body: Body, pose: Pose) -> None:
    """Teleport a body to a pose in the tool frame, with zero velocity.

    Args:
        robot: the robot.
        body: the body.
        pose: of the body in the tool frame.
    """
    body.set_pose(*bullet_compose(robot.tool_frame(), pose))


def rebuild_grasp_contacts(robot: Robot, body: Body, pose: Pose) -> None:
    """Place a held body in the tool frame, and replace its contacts.

    Bullet does not rotate the normals of persistent contacts with the bodies, and adds at most one
    contact to a pair of shapes in each collision detection. With one contact at a corner of each
    finger, a body would turn. The contacts are therefore detected at four poses with small tilts,
    at which each corner is the deepest point.

    Args:
        robot: the robot.
        body: the held body.
        pose: of the body in the tool frame.
    """
    body.set_pose((DISTANT_M,) * 3, pose.orientation)
    robot.world.detect_collisions()
    for tilt in _TILTS:
        place_in_tool_frame(robot, body, bullet_compose(tilt, pose))
        robot.world.detect_collisions()
    place_in_tool_frame(robot, body, pose)


def slip(before: Pose, after: Pose) -> tuple[float, float]:
    """Return by how much a held body has moved between the fingers.

    Args:
        before: a pose of the body in the tool frame.
        after: a later pose.

    Returns:
        The displacement perpendicular to the closing axis, metres, and the angle of the rotation.
    """
    distance_m = math.dist(before.position[1:], after.position[1:])  # x is the closing axis
    cosine = abs(sum(a * b for a, b in zip(before.orientation, after.orientation, strict=True)))
    return distance_m, 2 * math.acos(min(cosine, 1.0))
