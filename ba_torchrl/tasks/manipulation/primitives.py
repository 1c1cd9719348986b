"""Motion primitives of the close-loop experts.

Each returns the next command as a function of the present scene, without memory, so an expert can
be queried in any state. The environment limits the commands, see `CloseLoopActions.encode`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ba_torchrl.core.actions import GripperCommand, wrap_angle
from ba_torchrl.sim.bodies import Body, footprint_radius_m, vertical_extent, world_vertices
from ba_torchrl.sim.robots.base import Robot
from ba_torchrl.tasks.manipulation.clearance import grasp_clearance_m, half_gap_m, passing_height_m
from ba_torchrl.tasks.workspace import ActionLimits, Workspace

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
PUSH_HEIGHT_M = 0.02
"""Height of the tool above the lower bound of the workspace during a push."""
PUSH_HEIGHT_TOLERANCE_M = 0.015
"""Largest height above that of a tool that pushes."""
PUSH_OFFSET_M = 0.015
"""Largest distance from the line of a tool that pushes."""
PUSH_YAW_RAD = 0.4
"""Largest yaw error of a gripper that pushes."""
PUSH_OVERLAP_M = 0.01
"""Largest distance of a tool that pushes beyond the rear side of the body."""
OBSTACLE_SHARE = 0.9
"""A body is an obstacle of the approach if the path comes closer to it than this share of the
distance between the body and the start of the push."""
STANDOFF_M = 0.08
"""Distance from a body to the point from which it is pushed."""


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
    """Return the body between fingers that press on it, None without one.

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


def release(body: Body, floor_m: float, limits: ActionLimits) -> GripperCommand:
    """Return the next command to lower the held body to the floor and open the fingers.

    Args:
        floor_m: height of the floor, metres.
    """
    gap = max(vertical_extent(body)[0] - floor_m, 0.0)
    return lift(-gap, OPEN if gap <= limits.step_m else CLOSED)


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


def push(
    robot: Robot,
    body: Body,
    goal: tuple[float, float],
    *,
    workspace: Workspace,
    limits: ActionLimits,
    opening: float,
    stop_short_m: float,
) -> GripperCommand:
    """Return the next command to push a body along the straight line to a goal.

    The line between the fingers is perpendicular to the line of the push. On the line behind the
    body the gripper pushes. Elsewhere it first moves behind the body, over its top if the body is
    an obstacle. The tolerance of the line is larger during the push than at the end of the
    approach, so that the two phases do not alternate. A held body is released first, and the
    fingers stay open until they are above it. A body at the border, which leaves no room behind it,
    is grasped and dragged away from there.

    Args:
        goal: goal of the tool, metres.
        stop_short_m: distance before the goal at which the tool stops.
    """
    position, yaw = robot.tool_pose()
    x, y, z = position
    bx, by, _ = body.position
    length = math.dist((bx, by), goal)
    ux, uy = ((goal[0] - bx) / length, (goal[1] - by) / length) if length > 1e-6 else (1.0, 0.0)
    behind = behind_point(robot, body, (ux, uy), workspace)
    has_room = has_room_behind(robot, body, behind)
    held = grasped_body(robot)
    if held is body and not has_room:
        travel = min(length, limits.step_m)
        return GripperCommand(CLOSED, travel * ux, travel * uy, 0.0, 0.0)
    if held is not None:
        return release(held, workspace.z[0], limits)
    if not has_room and fits_between_fingers(robot, body):
        return grasp(robot, body, limits)
    along = (x - bx) * ux + (y - by) * uy
    offset = abs((y - by) * ux - (x - bx) * uy)
    across = math.atan2(uy, ux) + math.pi / 2
    target_yaw = nearest_equivalent_yaw(yaw, across, limits, math.pi)
    turn = abs(wrap_angle(target_yaw - yaw))
    low_z = workspace.z[0] + PUSH_HEIGHT_M

    half = body.shape.height_m / 2
    is_low = z < low_z + PUSH_HEIGHT_TOLERANCE_M
    is_on_line = along < -half + PUSH_OVERLAP_M and offset < PUSH_OFFSET_M
    if is_low and is_on_line and turn < PUSH_YAW_RAD:
        distance = math.dist((x, y), goal) - stop_short_m
        travel = max(min(distance, limits.step_m / max(abs(ux), abs(uy))), 0.0)
        # towards the goal from the tool, so that its offset from the line decreases
        gx, gy = goal[0] - x, goal[1] - y
        norm = math.hypot(gx, gy) or 1.0
        target = (x + travel * gx / norm, y + travel * gy / norm, low_z)
        return move_toward(robot, target, target_yaw, opening)

    over_z = body.position[2] + half + passing_height_m(robot.gripper)
    is_behind = max(abs(behind[0] - x), abs(behind[1] - y)) <= ALIGNED_M and turn <= ALIGNED_RAD
    is_obstacle = not is_behind and distance_to_segment(
        (bx, by), (x, y), behind
    ) < OBSTACLE_SHARE * math.dist(behind, (bx, by))
    is_around = math.dist((x, y), (bx, by)) < footprint_radius_m(body)
    moves_away = (behind[0] - x) * (bx - x) + (behind[1] - y) * (by - y) <= 0
    if is_obstacle and not is_around and moves_away:
        # The tool keeps its height until it is further out. If it rose here, where it descends
        # further out, a learner's mean of the two would hover in between.
        is_above = z + robot.gripper.lowest_tip_m >= body.position[2] + half
        target_z = min(max(z, low_z), over_z)
        return move_toward(robot, (*behind, target_z), target_yaw if is_above else yaw, opening)
    if is_obstacle and z < over_z - 1e-3:
        stays_open = is_around and robot.commanded_opening >= IS_OPEN
        return lift(over_z - z, OPEN if stays_open else opening)
    return move_toward(robot, (*behind, over_z if is_obstacle else low_z), target_yaw, opening)


def behind_point(
    robot: Robot,
    body: Body,
    direction: tuple[float, float],
    workspace: Workspace,
) -> tuple[float, float]:
    """Return the point of the workspace from which to push a body.

    It is `STANDOFF_M` from the body's origin; closer near the border, but never so close that the
    gripper touches the body.

    Args:
        direction: unit vector of the push.
    """
    bx, by, _ = body.position
    inner = body.shape.mesh().vertices[:, :2]
    nearest = float((inner**2).sum(axis=1).max() ** 0.5)
    nearest += robot.gripper.half_width_m
    limit = STANDOFF_M
    for b, u, (low, high) in zip((bx, by), direction, (workspace.x, workspace.y), strict=True):
        if abs(u) > 1e-9:
            limit = min(limit, (b - (low if u > 0 else high)) / u)
    back = max(limit, min(nearest, STANDOFF_M))
    x, y, _ = workspace.clip((bx - back * direction[0], by - back * direction[1], 0.0))
    return x, y


def has_room_behind(robot: Robot, body: Body, behind: tuple[float, float]) -> bool:
    """Whether a gripper at the point from which to push a body does not touch the body.

    Args:
        behind: point of `behind_point`.
    """
    offset = np.subtract(behind, body.position[:2])
    distance = float(np.hypot(*offset))
    if distance == 0.0:
        return False
    extent = float(((world_vertices(body)[:, :2] - body.position[:2]) @ offset).max()) / distance
    return distance > extent + robot.gripper.half_width_m


def fits_between_fingers(robot: Robot, body: Body) -> bool:
    """Whether open fingers fit around a block."""
    return min(body.shape.bounds_m[1][:2]) < half_gap_m(robot.gripper)


def distance_to_segment(
    point: tuple[float, float], start: tuple[float, float], end: tuple[float, float]
) -> float:
    """Return the distance between a point and a line segment."""
    ex, ey = end[0] - start[0], end[1] - start[1]
    px, py = point[0] - start[0], point[1] - start[1]
    square = ex * ex + ey * ey
    share = min(max((px * ex + py * ey) / square, 0.0), 1.0) if square > 0 else 0.0
    return math.hypot(px - share * ex, py - share * ey)
