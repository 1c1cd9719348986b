"""Parts that experts are made of: each is a function of the scene, none keeps time.

An expert reads where things are and says what to do next, so it can be asked in any state: at the
start, half-way through somebody else's episode, or after the scene was disturbed. Its commands go
through the same bounded action space as anybody's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from ba_torchrl.actions import GripperCommand, wrap_angle
from ba_torchrl.sim.bodies import Body, footprint_radius_m, vertical_extent
from ba_torchrl.sim.geometry import Vector
from ba_torchrl.sim.robots.base import Robot
from ba_torchrl.tasks.clearance import (
    grasp_clearance_m,
    passing_height_m,
    reach_m,
    tips_below_tool_m,
)
from ba_torchrl.tasks.pick_place_commands import carrying_pose
from ba_torchrl.tasks.workspace import ActionLimits, Workspace

OPEN, CLOSED = 1.0, 0.0
ALIGNED_M = 4e-3
ALIGNED_RAD = 0.08


def move_toward(
    robot: Robot, target: tuple[float, float, float], yaw_rad: float, opening: float
) -> GripperCommand:
    """Return the command that goes to a pose; the environment bounds each component."""
    position, yaw = robot.tool_pose()
    dx, dy, dz = (t - p for t, p in zip(target, position, strict=True))
    return GripperCommand(opening, dx, dy, dz, wrap_angle(yaw_rad - yaw))


def nearest_equivalent_yaw(
    yaw_rad: float, target_rad: float, limits: ActionLimits, period_rad: float = 2 * math.pi
) -> float:
    """Return the yaw to turn to.

    Args:
        yaw_rad: the gripper's.
        target_rad: wanted, up to multiples of the period.
        limits: of an action; a gripper that cannot turn keeps its yaw.
        period_rad: yaws this far apart serve alike.
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


def lift(height_m: float, opening: float = CLOSED) -> GripperCommand:
    """Return the command that goes straight up."""
    return GripperCommand(opening, 0.0, 0.0, height_m, 0.0)


def grasp(robot: Robot, body: Body, limits: ActionLimits) -> GripperCommand:
    """Grasp a block with four-fold symmetry that stands free.

    The gripper goes sideways, turns and comes down at once, but stays above the block until the
    action that finds it aligned; the action that arrives closes the fingers.
    """
    (x, y, z), yaw = robot.tool_pose()
    bx, by, bz = body.position
    target_yaw = nearest_equivalent_yaw(yaw, body.yaw_rad, limits, math.pi / 2)
    above_z = bz + body.shape.height_m / 2 + passing_height_m(robot.gripper)
    is_beside = max(abs(bx - x), abs(by - y)) <= ALIGNED_M
    is_aligned = is_beside and abs(wrap_angle(target_yaw - yaw)) <= ALIGNED_RAD
    if robot.opening() < 0.9:
        return lift(above_z - z if z < above_z and not is_beside else 0.0, OPEN)
    if is_aligned:
        return move_toward(
            robot, (bx, by, bz), target_yaw, CLOSED if z - bz <= limits.step_m else OPEN
        )
    if z < above_z - 1e-3 and not is_beside:
        return lift(above_z - z, OPEN)  # the fingers may stand beside the block
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
    target_yaw = nearest_equivalent_yaw(yaw, across, limits, math.pi)
    turn = abs(wrap_angle(target_yaw - yaw))
    low_z = workspace.z[0] + 0.02

    half = body.shape.height_m / 2
    if z < low_z + 0.015 and along < -half + 0.01 and aside < 0.015 and turn < 0.4:
        distance = math.dist((x, y), goal) - stop_short_m
        travel = max(min(distance, limits.step_m / max(abs(ux), abs(uy))), 0.0)
        # aim along the line from the gripper's own place, so that the offset shrinks
        gx, gy = goal[0] - x, goal[1] - y
        norm = math.hypot(gx, gy) or 1.0
        target = (x + travel * gx / norm, y + travel * gy / norm, low_z)
        return move_toward(robot, target, target_yaw, opening)

    behind = behind_point(robot, body, (ux, uy), workspace)
    over_z = body.position[2] + half + passing_height_m(robot.gripper)
    arrived = max(abs(behind[0] - x), abs(behind[1] - y)) <= ALIGNED_M and turn <= ALIGNED_RAD
    in_the_way = not arrived and _distance_to_segment((bx, by), (x, y), behind) < 0.9 * math.dist(
        behind, (bx, by)
    )
    if in_the_way and z < over_z - 1e-3:
        return lift(over_z - z, opening)
    return move_toward(robot, (*behind, over_z if in_the_way else low_z), target_yaw, opening)


def behind_point(
    robot: Robot,
    body: Body,
    direction: tuple[float, float],
    workspace: Workspace,
    standoff_m: float = 0.08,
) -> tuple[float, float]:
    """Return the point from which to push a body along ``direction``, inside the workspace.

    Near the border the point moves up to the body, along the line, until the gripper fits.
    """
    bx, by, _ = body.position
    inner = body.shape.mesh().vertices[:, :2]
    nearest = float((inner**2).sum(axis=1).max() ** 0.5)
    nearest += robot.gripper.half_width_m
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


HOVER_M = 0.012
"""Gap under a body, or under the fingertips, that passes over another."""
SLACK_M = 8e-3
"""Part of that gap that may be missing on the way."""
RELEASE_GAP_M = 1e-3
"""A body is let go this far above what it will rest on."""


def carry_to(
    robot: Robot,
    body: Body,
    position: Vector,
    limits: ActionLimits,
    *,
    yaw_rad: float | None = None,
    obstacles: Sequence[Body] = (),
    ceiling_m: float = math.inf,
    hover_m: float = HOVER_M,
) -> GripperCommand:
    """Carry the body in the gripper to where it is to lie, and let go of it there.

    It goes over everything in its way, comes down once it is above its place, and the action that
    arrives opens the fingers.

    Args:
        robot: it holds the body.
        body: what is held.
        position: where the body's origin is to be.
        limits: of an action.
        yaw_rad: final yaw of the gripper; None keeps the present one.
        obstacles: bodies to pass over, with what the body is to rest on.
        ceiling_m: the tool never goes higher.
        hover_m: gap that the body keeps to what it passes over, and to its place before it comes
            down; more is needed where its place has a rim.
    """
    tool_pose, pose = robot.tool_frame(), body.pose
    tool, yaw = tool_pose.position, tool_pose.yaw_rad
    turn = 0.0 if yaw_rad is None else wrap_angle(yaw_rad - yaw)
    x, y, _ = pose.position
    released = (*position[:2], position[2] + RELEASE_GAP_M)
    target = carrying_pose(tool_pose, pose, pose.moved_to(released, turn)).position
    is_beside = max(abs(position[0] - x), abs(position[1] - y)) <= ALIGNED_M
    if is_beside and abs(turn) <= ALIGNED_RAD:
        arrives = tool[2] - target[2] <= limits.step_m
        return move_toward(robot, target, yaw + turn, OPEN if arrives else CLOSED)
    over = (*target[:2], min(target[2] + hover_m, ceiling_m))
    return travel(
        robot,
        over,
        yaw + turn,
        CLOSED,
        limits,
        below_m=max(tool[2] - vertical_extent(body)[0], tips_below_tool_m(robot)),
        obstacles=[other for other in obstacles if other is not body],
        ceiling_m=ceiling_m,
        hover_m=hover_m,
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
    """Go over everything in the way to a body and close the fingers on it.

    Args:
        robot: its gripper is empty.
        body: what to grasp, at its origin.
        limits: of an action.
        yaws_rad: yaws of the gripper at which the fingers close on it; each stands for its
            reverse too. Of these the nearest one at which nothing stands where the fingers go.
        obstacles: bodies to keep clear of.
        ceiling_m: the tool never goes higher.
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
    is_beside = max(abs(bx - x), abs(by - y)) <= ALIGNED_M
    is_aligned = is_beside and abs(wrap_angle(target_yaw - yaw)) <= ALIGNED_RAD
    if robot.opening() < 0.9 and math.dist((x, y), (bx, by)) < footprint_radius_m(body):
        return lift(5e-3, OPEN)  # the body may stand between the fingers
    if is_aligned and robot.opening() >= 0.9:
        return move_toward(
            robot, (bx, by, bz), target_yaw, CLOSED if z - bz <= limits.step_m else OPEN
        )
    below_m = tips_below_tool_m(robot)
    over_z = min(vertical_extent(body)[1] + below_m + HOVER_M, ceiling_m)
    return travel(
        robot,
        (bx, by, over_z),
        target_yaw,
        OPEN,
        limits,
        below_m=below_m,
        obstacles=[body, *others],
        ceiling_m=ceiling_m,
    )


def travel(
    robot: Robot,
    target: Vector,
    yaw_rad: float,
    opening: float,
    limits: ActionLimits,
    *,
    below_m: float,
    obstacles: Sequence[Body],
    ceiling_m: float = math.inf,
    hover_m: float = HOVER_M,
) -> GripperCommand:
    """Go to a pose: straight where the next action touches nothing, else level, else up first.

    Args:
        robot: the robot.
        target: where the tool goes.
        yaw_rad: yaw in the end.
        opening: of the gripper on the way.
        limits: of an action.
        below_m: how far hand and load hang below the tool.
        obstacles: bodies to pass over.
        ceiling_m: the tool never goes higher.
        hover_m: gap kept above the obstacles.
    """
    start = robot.tool_pose()[0]
    end = tuple(
        s + min(max(t - s, -limits.step_m), limits.step_m)
        for s, t in zip(start, target, strict=True)
    )
    hand = reach_m(robot.gripper)
    zones = [
        (
            body.position,
            hand + footprint_radius_m(body),
            vertical_extent(body)[1] + below_m + hover_m,
        )
        for body in obstacles
    ]
    if _height_needed(start, end, zones) is None:
        return move_toward(robot, target, yaw_rad, opening)
    needed = _height_needed(start, (end[0], end[1], start[2]), zones)
    if needed is None or start[2] >= ceiling_m - 1e-3:
        return move_toward(robot, (target[0], target[1], start[2]), yaw_rad, opening)
    return lift(min(needed + 1e-3, ceiling_m) - start[2], opening)


def _height_needed(
    start: Vector, end: Vector, zones: Sequence[tuple[Vector, float, float]]
) -> float | None:
    """Return how high the tool must be on a straight way, or None if it is high enough.

    Args:
        start: the tool's place now.
        end: its next place.
        zones: center, radius and least height of what the way may lead over.
    """
    needed = None
    for i in range(5):
        x, y, z = (s + (e - s) * i / 4 for s, e in zip(start, end, strict=True))
        for center, radius, height in zones:
            if z < height - SLACK_M and math.dist((x, y), center[:2]) < radius:
                needed = height if needed is None else max(needed, height)
    return needed
