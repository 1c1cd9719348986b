"""Parts that experts are made of: each is a function of the scene, none keeps time.

An expert reads where things are and says what to do next, so it can be asked in any state: at the
start, half-way through somebody else's episode, or after the scene was disturbed. Its commands go
through the same bounded action space as anybody's.
"""

from __future__ import annotations

import math

from ba_torchrl.actions import GripperCommand, wrap_angle
from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.robots.base import Robot
from ba_torchrl.tasks.base import Reach, Workspace

OPEN, CLOSED = 1.0, 0.0
ALIGNED_M = 4e-3
ALIGNED_RAD = 0.08
FINGER_HALF_M = 0.0095
"""Half the fingers' thickness, across the direction in which they open."""
CLEARANCE_M = 0.03
"""Height of the tool above a body's top at which the fingertips pass over it."""


def towards(
    robot: Robot, target: tuple[float, float, float], yaw_rad: float, opening: float
) -> GripperCommand:
    """Return the command that goes to a pose; the environment bounds each component."""
    position, yaw = robot.tool_pose()
    dx, dy, dz = (t - p for t, p in zip(target, position, strict=True))
    return GripperCommand(opening, dx, dy, dz, wrap_angle(yaw_rad - yaw))


def turned(
    yaw_rad: float, target_rad: float, reach: Reach, period_rad: float = 2 * math.pi
) -> float:
    """Return the yaw to turn to.

    Args:
        yaw_rad: the gripper's.
        target_rad: wanted, up to multiples of the period.
        reach: of an action; a gripper that cannot turn keeps its yaw.
        period_rad: yaws this far apart serve alike.
    """
    if not reach.turn_rad:
        return yaw_rad
    nearest = yaw_rad + wrap_angle(target_rad - yaw_rad, period_rad)
    if reach.yaw_range_rad is not None:
        low, high = reach.yaw_range_rad
        if nearest < low and nearest + period_rad <= high:
            return nearest + period_rad
        if nearest > high and nearest - period_rad >= low:
            return nearest - period_rad
    return nearest


def lift(height_m: float, opening: float = CLOSED) -> GripperCommand:
    """Return the command that goes straight up."""
    return GripperCommand(opening, 0.0, 0.0, height_m, 0.0)


def grasp(robot: Robot, body: Body, reach: Reach) -> GripperCommand:
    """Grasp a block with four-fold symmetry that stands free.

    The gripper goes sideways, turns and comes down at once, but stays above the block until the
    action that finds it aligned; the action that arrives closes the fingers.
    """
    (x, y, z), yaw = robot.tool_pose()
    bx, by, bz = body.position
    target_yaw = turned(yaw, body.yaw_rad, reach, math.pi / 2)
    above_z = bz + body.shape.height_m / 2 + CLEARANCE_M
    is_beside = max(abs(bx - x), abs(by - y)) <= ALIGNED_M
    is_aligned = is_beside and abs(wrap_angle(target_yaw - yaw)) <= ALIGNED_RAD
    if robot.opening() < 0.9:
        return lift(above_z - z if z < above_z and not is_beside else 0.0, OPEN)
    if is_aligned:
        return towards(robot, (bx, by, bz), target_yaw, CLOSED if z - bz <= reach.step_m else OPEN)
    if z < above_z - 1e-3 and not is_beside:
        return lift(above_z - z, OPEN)  # the fingers may stand beside the block
    return towards(robot, (bx, by, above_z), target_yaw, OPEN)


def push(
    robot: Robot,
    body: Body,
    goal: tuple[float, float],
    *,
    workspace: Workspace,
    reach: Reach,
    opening: float,
    stop_short_m: float,
) -> GripperCommand:
    """Push a body along the straight line to a goal, the fingers standing across the line.

    On the line behind the body the gripper pushes; anywhere else it goes behind the body first,
    over its top if the body is in the way. Leaving the line by a few millimetres is tolerated
    while pushing and corrected while approaching, so that the two never alternate.
    """
    position, yaw = robot.tool_pose()
    x, y, z = position
    bx, by, _ = body.position
    length = math.dist((bx, by), goal)
    ux, uy = ((goal[0] - bx) / length, (goal[1] - by) / length) if length > 1e-6 else (1.0, 0.0)
    along = (x - bx) * ux + (y - by) * uy
    aside = abs((y - by) * ux - (x - bx) * uy)
    across = math.atan2(uy, ux) + math.pi / 2
    target_yaw = turned(yaw, across, reach, math.pi)
    turn = abs(wrap_angle(target_yaw - yaw))
    low_z = workspace.z[0] + 0.02

    half = body.shape.height_m / 2
    if z < low_z + 0.015 and along < -half + 0.01 and aside < 0.015 and turn < 0.4:
        distance = math.dist((x, y), goal) - stop_short_m
        travel = max(min(distance, reach.step_m / max(abs(ux), abs(uy))), 0.0)
        # aim along the line from the gripper's own place, so that the offset shrinks
        gx, gy = goal[0] - x, goal[1] - y
        norm = math.hypot(gx, gy) or 1.0
        target = (x + travel * gx / norm, y + travel * gy / norm, low_z)
        return towards(robot, target, target_yaw, opening)

    behind = behind_point(body, (ux, uy), workspace)
    over_z = body.position[2] + half + CLEARANCE_M
    arrived = max(abs(behind[0] - x), abs(behind[1] - y)) <= ALIGNED_M and turn <= ALIGNED_RAD
    in_the_way = not arrived and _distance_to_segment((bx, by), (x, y), behind) < 0.9 * math.dist(
        behind, (bx, by)
    )
    if in_the_way and z < over_z - 1e-3:
        return lift(over_z - z, opening)
    return towards(robot, (*behind, over_z if in_the_way else low_z), target_yaw, opening)


def behind_point(
    body: Body, direction: tuple[float, float], workspace: Workspace, standoff_m: float = 0.08
) -> tuple[float, float]:
    """Return the point from which to push a body along ``direction``, inside the workspace.

    Near the border the point moves up to the body, along the line, until the gripper fits.
    """
    bx, by, _ = body.position
    inner = body.shape.mesh().vertices[:, :2]
    nearest = float((inner**2).sum(axis=1).max() ** 0.5) + FINGER_HALF_M
    limit = standoff_m
    for b, u, (low, high) in zip((bx, by), direction, (workspace.x, workspace.y), strict=True):
        if abs(u) > 1e-9:
            limit = min(limit, (b - (low if u > 0 else high)) / u)
    back = max(limit, min(nearest, standoff_m))
    x, y, _ = workspace.clip((bx - back * direction[0], by - back * direction[1], 0.0))
    return x, y


def _distance_to_segment(
    point: tuple[float, float], start: tuple[float, float], end: tuple[float, float]
) -> float:
    ex, ey = end[0] - start[0], end[1] - start[1]
    px, py = point[0] - start[0], point[1] - start[1]
    square = ex * ex + ey * ey
    place = min(max((px * ex + py * ey) / square, 0.0), 1.0) if square > 0 else 0.0
    return math.hypot(px - place * ex, py - place * ey)
