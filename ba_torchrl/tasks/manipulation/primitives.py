"""Motion primitives of the close-loop experts.

Each returns the next command as a function of the present scene, without memory, so an expert can
be queried in any state. The environment limits the commands, see `CloseLoopActions.encode`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from ba_torchrl.core.actions import GripperCommand, wrap_angle
from ba_torchrl.sim.bodies import Body, vertical_extent
from ba_torchrl.sim.robots.base import Robot
from ba_torchrl.tasks.manipulation.clearance import grasp_clearance_m, passing_height_m
from ba_torchrl.tasks.workspace import ActionLimits

OPEN, CLOSED = 1.0, 0.0
"""The ends of the range of the gripper's opening."""
IS_OPEN, IS_CLOSED = 0.5, 0.4
"""Least opening of an open gripper, and largest of a closed one. With 0.9 and 0.1, the expert does
something else after a policy's small error of the opening, and the image hardly shows why."""
LEAST_SQUEEZE = 0.01
"""Least difference between the opening of fingers that press on a body and the commanded one."""
ALIGNED_M = 4e-3
"""Largest horizontal offset, along each axis, of a gripper that is aligned with its target."""
ALIGNED_RAD = 0.08
"""Largest yaw error of a gripper that is aligned with its target."""
DESCENT_OFFSET_M = 0.02
"""Largest horizontal offset, along each axis, of a gripper that descends towards its target."""


def move_toward(
    robot: Robot, target: tuple[float, float, float], yaw_rad: float, opening: float
) -> GripperCommand:
    """Return the command towards a pose; the environment limits it."""
    position, yaw = robot.tool_pose()
    dx, dy, dz = (t - p for t, p in zip(target, position, strict=True))
    return GripperCommand(opening, dx, dy, dz, wrap_angle(yaw_rad - yaw))


def nearest_equivalent_yaw(
    yaw_rad: float, target_rad: float, limits: ActionLimits, period_rad: float = 2 * math.pi
) -> float:
    """Return the yaw nearest to the present one that is equivalent to a target yaw.

    Args:
        limits: limits of an action; a gripper that cannot turn keeps its yaw.
        period_rad: yaws that differ by a multiple of this are equivalent.
    """
    if not limits.turn_rad:
        return yaw_rad
    nearest = yaw_rad + wrap_angle(target_rad - yaw_rad, period_rad)
    if limits.yaw_range_rad is not None:
        low, high = limits.yaw_range_rad
        if nearest < low and nearest + period_rad <= high:
            return nearest + period_rad
        if nearest > high and nearest - period_rad >= low:
            return nearest - period_rad
    return nearest


def grasped_body(robot: Robot) -> Body | None:
    """Return the body on which both fingers press; None without such a body.

    Open fingers can touch a wide body on both sides, too, but do not press on it.
    """
    is_pressing = robot.commanded_opening < robot.opening() - LEAST_SQUEEZE
    return robot.held_body() if is_pressing else None


def closing(robot: Robot) -> float:
    """Return the opening to command for an empty gripper to close.

    Fingers that something stopped open first: they close no further by the same command.
    """
    is_stopped = robot.commanded_opening < IS_CLOSED <= robot.opening()
    return OPEN if is_stopped else CLOSED


def lift(height_m: float, opening: float = CLOSED) -> GripperCommand:
    """Return the command of a vertical displacement."""
    return GripperCommand(opening, 0.0, 0.0, height_m, 0.0)


def can_descend(
    robot: Robot,
    body: Body,
    target_yaw_rad: float,
    limits: ActionLimits,
    others: Sequence[Body] = (),
) -> bool:
    """Return whether the open gripper can descend to a body on a straight line, and turn meanwhile.

    It can if it is aligned, or close to that with both fingers clear of all bodies when the tips
    pass the top of this one. A learner's errors in yaw and position then lead to a grasp, which
    aligns the body, and not to another ascent.

    Args:
        others: bodies to avoid besides it.
    """
    (x, y, z), yaw = robot.tool_pose()
    bx, by, bz = body.position
    offset, turn = max(abs(bx - x), abs(by - y)), wrap_angle(target_yaw_rad - yaw)
    if offset <= ALIGNED_M and abs(turn) <= ALIGNED_RAD:
        return True
    if offset > DESCENT_OFFSET_M or abs(turn) > limits.turn_rad + ALIGNED_RAD:
        return False
    above = z - (vertical_extent(body)[1] - robot.gripper.lowest_tip_m)
    share = min(max(above / (z - bz), 0.0), 1.0) if z > bz else 0.0
    at = (x + share * (bx - x), y + share * (by - y), bz)
    bodies = [body, *others]
    return grasp_clearance_m(robot.gripper, body, yaw + share * turn, bodies, at=at) > 0


def grasp(robot: Robot, body: Body, limits: ActionLimits) -> GripperCommand:
    """Return the next command to grasp a block with four-fold symmetry and no obstacles near it.

    The gripper moves above the block, descends once its fingers have free ways, and closes them
    with the action that reaches the grasp height.
    """
    (x, y, z), yaw = robot.tool_pose()
    bx, by, bz = body.position
    target_yaw = nearest_equivalent_yaw(yaw, body.yaw_rad, limits, math.pi / 2)
    above_z = bz + body.shape.height_m / 2 + passing_height_m(robot.gripper)
    is_centered = max(abs(bx - x), abs(by - y)) <= ALIGNED_M
    if robot.opening() < IS_OPEN:
        # at the block, fingers open before the hand moves, unless something stops them
        is_stopped = robot.commanded_opening >= IS_OPEN
        return lift(max(above_z - z, 0.0) if is_stopped or not is_centered else 0.0, OPEN)
    if can_descend(robot, body, target_yaw, limits):
        return move_toward(
            robot, (bx, by, bz), target_yaw, CLOSED if z - bz <= limits.step_m else OPEN
        )
    if z < above_z - 1e-3 and not is_centered:
        return lift(above_z - z, OPEN)  # a horizontal motion could push the block
    return move_toward(robot, (bx, by, above_z), target_yaw, OPEN)
