"""Motion primitives of the close-loop experts that pick, carry and place over obstacles.

Like `ba_torchrl.tasks.manipulation.primitives`, each is a function of the present scene.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from ba_torchrl.core.actions import GripperCommand, wrap_angle
from ba_torchrl.sim.bodies import Body, footprint_radius_m, vertical_extent
from ba_torchrl.sim.geometry import Vector, carrying_pose
from ba_torchrl.sim.robots.base import Robot
from ba_torchrl.tasks.manipulation.clearance import (
    finger_extent_m,
    grasp_clearance_m,
    tips_below_tool_m,
)
from ba_torchrl.tasks.manipulation.primitives import (
    ALIGNED_RAD,
    CLOSED,
    DESCENT_OFFSET_M,
    IS_OPEN,
    OPEN,
    can_descend,
    lift,
    move_toward,
    nearest_equivalent_yaw,
)
from ba_torchrl.tasks.workspace import ActionLimits

TRAVEL_CLEARANCE_M = 0.02
"""Gap between obstacles and the held body, or the fingertips, that pass over them."""
CLEARANCE_TOLERANCE_M = 14e-3
"""Part of that gap that may be missing during the motion."""
_SAMPLE_M = 0.01
"""Largest distance between the samples of a motion."""
RELEASE_GAP_M = 1e-3
"""Height of a body above its support at its release."""


def carry_to(
    robot: Robot,
    body: Body,
    position: Vector,
    limits: ActionLimits,
    *,
    yaw_rad: float | None = None,
    obstacles: Sequence[Body] = (),
    ceiling_m: float = math.inf,
) -> GripperCommand:
    """Return the next command to carry the held body to a position and release it there.

    The body passes over the obstacles and descends once it is above its target. The action that
    reaches the target opens the fingers.

    Args:
        position: target position of the origin of the body.
        yaw_rad: final yaw of the gripper; None for its present yaw.
        obstacles: bodies to pass over, including the support at the target.
        ceiling_m: largest height of the tool.
    """
    tool_pose, pose = robot.tool_frame(), body.pose
    tool, yaw = tool_pose.position, tool_pose.yaw_rad
    turn = 0.0 if yaw_rad is None else wrap_angle(yaw_rad - yaw)
    x, y, _ = pose.position
    released = (*position[:2], position[2] + RELEASE_GAP_M)
    target = carrying_pose(tool_pose, pose, pose.moved_to(released, turn)).position
    offset = max(abs(position[0] - x), abs(position[1] - y))
    if offset <= DESCENT_OFFSET_M and abs(turn) <= max(limits.turn_rad, ALIGNED_RAD):
        arrives = tool[2] - target[2] <= limits.step_m
        return move_toward(robot, target, yaw + turn, OPEN if arrives else CLOSED)
    above = (*target[:2], min(target[2] + TRAVEL_CLEARANCE_M, ceiling_m))
    return travel(
        robot,
        above,
        yaw + turn,
        CLOSED,
        below_m=max(tool[2] - vertical_extent(body)[0], tips_below_tool_m(robot)),
        obstacles=[other for other in obstacles if other is not body],
        ceiling_m=ceiling_m,
    )


def pick_up(
    robot: Robot,
    body: Body,
    limits: ActionLimits,
    *,
    yaws_rad: Sequence[float],
    obstacles: Sequence[Body] = (),
    ceiling_m: float = math.inf,
) -> GripperCommand:
    """Return the next command to pass over the obstacles to a body and grasp it at its origin.

    Args:
        robot: the robot, with an empty gripper.
        yaws_rad: yaws of the gripper at which the fingers close on the body, up to half turns. The
            grasp uses the nearest one at which the fingers have clearance.
        ceiling_m: largest height of the tool.
    """
    (x, y, z), yaw = robot.tool_pose()
    bx, by, bz = body.position
    others = [other for other in obstacles if other is not body]
    target_yaw = min(
        (nearest_equivalent_yaw(yaw, wanted, limits, math.pi) for wanted in yaws_rad),
        key=lambda wanted: (
            grasp_clearance_m(robot.gripper, body, wanted, others) <= 0,
            abs(wrap_angle(wanted - yaw)),
        ),
    )
    if robot.opening() < IS_OPEN and math.dist((x, y), (bx, by)) < footprint_radius_m(body):
        return lift(5e-3, OPEN)  # the body may be between the fingers
    if robot.opening() >= IS_OPEN and can_descend(robot, body, target_yaw, limits, others):
        return move_toward(
            robot, (bx, by, bz), target_yaw, CLOSED if z - bz <= limits.step_m else OPEN
        )
    below_m = tips_below_tool_m(robot)
    over_z = min(vertical_extent(body)[1] + below_m + TRAVEL_CLEARANCE_M, ceiling_m)
    return travel(
        robot,
        (bx, by, over_z),
        target_yaw,
        OPEN,
        below_m=below_m,
        obstacles=[body, *others],
        ceiling_m=ceiling_m,
    )


def travel(
    robot: Robot,
    target: Vector,
    yaw_rad: float,
    opening: float,
    *,
    below_m: float,
    obstacles: Sequence[Body],
    ceiling_m: float = math.inf,
    clearance_m: float = TRAVEL_CLEARANCE_M,
) -> GripperCommand:
    """Return the next command towards a pose, over the obstacles.

    The displacement is straight if the whole way has clearance, else horizontal if that has
    clearance, else vertical. So the tool rises before it moves sideways, and to a height from which
    small errors lead to no other displacement: what a learner can imitate.

    Args:
        below_m: distance from the tool down to the lowest point of gripper and held body.
        obstacles: bodies to pass over.
        ceiling_m: largest height of the tool.
        clearance_m: gap above the obstacles.
    """
    start = robot.tool_pose()[0]
    extent = finger_extent_m(robot.gripper)
    zones = [
        (
            body.position,
            extent + footprint_radius_m(body),
            vertical_extent(body)[1] + below_m + clearance_m,
        )
        for body in obstacles
    ]
    if _height_needed(start, target, zones) is None:
        return move_toward(robot, target, yaw_rad, opening)
    needed = _height_needed(start, (target[0], target[1], start[2]), zones)
    if needed is None or start[2] >= ceiling_m - 1e-3:
        return move_toward(robot, (target[0], target[1], start[2]), yaw_rad, opening)
    return lift(min(needed + 1e-3, ceiling_m) - start[2], opening)


def _height_needed(
    start: Vector, end: Vector, zones: Sequence[tuple[Vector, float, float]]
) -> float | None:
    """Return the height that a straight motion of the tool needs; None if it is high enough.

    Args:
        zones: centre and radius of the zone around each obstacle, and height of the tool there.
    """
    needed = None
    count = max(4, math.ceil(math.dist(start, end) / _SAMPLE_M))
    for i in range(count + 1):
        x, y, z = (s + (e - s) * i / count for s, e in zip(start, end, strict=True))
        for center, radius, height in zones:
            if z < height - CLEARANCE_TOLERANCE_M and math.dist((x, y), center[:2]) < radius:
                needed = height if needed is None else max(needed, height)
    return needed
