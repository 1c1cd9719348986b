"""Pushing a body along a straight line to a goal, in close loop.

Like `ba_torchrl.tasks.manipulation.primitives`, each command is a function of the present scene.
"""

from __future__ import annotations

import math
from enum import Enum, auto

import numpy as np

from ba_torchrl.core.actions import GripperCommand, wrap_angle
from ba_torchrl.sim.bodies import Body, footprint_radius_m, vertical_extent, world_vertices
from ba_torchrl.sim.robots.base import Robot
from ba_torchrl.tasks.manipulation.clearance import half_gap_m, passing_height_m
from ba_torchrl.tasks.manipulation.primitives import (
    ALIGNED_M,
    ALIGNED_RAD,
    CLOSED,
    IS_OPEN,
    OPEN,
    grasp,
    grasped_body,
    lift,
    move_toward,
    nearest_equivalent_yaw,
)
from ba_torchrl.tasks.manipulation.progress_terms import nearness, turn_m
from ba_torchrl.tasks.workspace import ActionLimits, Workspace

PUSH_HEIGHT_M = 0.02
"""Height of the tool above the lower bound of the workspace during a push."""
PUSH_HEIGHT_TOLERANCE_M = 0.015
"""Largest height above a pushing tool's."""
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


class PushPhase(Enum):
    """What the gripper does next; the first phase whose condition holds."""

    DRAG = auto()
    """A body at the border, which leaves no room behind it, is held and dragged away from there."""
    RELEASE = auto()
    """A held body is lowered to the floor and released."""
    GRASP = auto()
    """A body at the border is grasped."""
    PUSH = auto()
    """The tool is low, on the line behind the body and turned across it, and moves to the goal."""
    MOVE_AWAY = auto()
    """The body is in the way of the approach, and the tool moves away from it."""
    RISE = auto()
    """The tool rises over the body in its way."""
    APPROACH = auto()
    """The tool moves behind the body, over its top if the body is in the way."""


class Push:
    """A push in the present scene.

    The line between the fingers is perpendicular to the line of the push. The tolerance of the line
    is larger during the push than at the end of the approach, so that the two phases do not
    alternate. Fingers that release a held body stay open until they are above it.

    Args:
        goal: goal of the tool, metres.
        opening: of the fingers that push.
        stop_short_m: distance before the goal at which the tool stops.
    """

    def __init__(
        self,
        robot: Robot,
        body: Body,
        goal: tuple[float, float],
        *,
        workspace: Workspace,
        limits: ActionLimits,
        opening: float,
        stop_short_m: float,
    ) -> None:
        self.robot, self.body, self.goal = robot, body, goal
        self.workspace, self.limits = workspace, limits
        self.opening, self.stop_short_m = opening, stop_short_m
        self.position, self.yaw_rad = robot.tool_pose()
        self.length_m, self.direction = push_line(body, goal)
        self.behind = behind_point(robot, body, self.direction, workspace)
        self.has_room = has_room_behind(robot, body, self.behind)
        self.held = grasped_body(robot)
        across = math.atan2(self.direction[1], self.direction[0]) + math.pi / 2
        self.target_yaw_rad = nearest_equivalent_yaw(self.yaw_rad, across, limits, math.pi)
        self.turn_rad = abs(wrap_angle(self.target_yaw_rad - self.yaw_rad))
        self.low_m = workspace.z[0] + PUSH_HEIGHT_M
        self.top_m = body.position[2] + body.shape.height_m / 2
        self.over_m = self.top_m + passing_height_m(robot.gripper)

    def command(self) -> GripperCommand:
        """Return the next command."""
        return {
            PushPhase.DRAG: self._drag,
            PushPhase.RELEASE: self._release,
            PushPhase.GRASP: lambda: grasp(self.robot, self.body, self.limits),
            PushPhase.PUSH: self._push,
            PushPhase.MOVE_AWAY: self._move_away,
            PushPhase.RISE: self._rise,
            PushPhase.APPROACH: self._approach,
        }[self.phase()]()

    def phase(self) -> PushPhase:
        """Return the phase of the present scene."""
        if self.held is not None:
            is_stuck = self.held is self.body and not self.has_room
            return PushPhase.DRAG if is_stuck else PushPhase.RELEASE
        if not self.has_room and fits_between_fingers(self.robot, self.body):
            return PushPhase.GRASP
        if self._can_push():
            return PushPhase.PUSH
        if not self._is_obstacle():
            return PushPhase.APPROACH
        (x, y, z), (bx, by, _) = self.position, self.body.position
        moves_away = (self.behind[0] - x) * (bx - x) + (self.behind[1] - y) * (by - y) <= 0
        if moves_away and not self._is_around():
            return PushPhase.MOVE_AWAY
        return PushPhase.RISE if z < self.over_m - 1e-3 else PushPhase.APPROACH

    def _drag(self) -> GripperCommand:
        travel_m = min(self.length_m, self.limits.step_m)
        ux, uy = self.direction
        return GripperCommand(CLOSED, travel_m * ux, travel_m * uy, 0.0, 0.0)

    def _release(self) -> GripperCommand:
        gap_m = max(vertical_extent(self.held)[0] - self.workspace.z[0], 0.0)
        return lift(-gap_m, OPEN if gap_m <= self.limits.step_m else CLOSED)

    def _push(self) -> GripperCommand:
        x, y, _ = self.position
        distance_m = math.dist((x, y), self.goal) - self.stop_short_m
        longest_m = self.limits.step_m / max(map(abs, self.direction))
        travel_m = max(min(distance_m, longest_m), 0.0)
        # towards the goal from the tool, so that its offset from the line decreases
        gx, gy = self.goal[0] - x, self.goal[1] - y
        norm = math.hypot(gx, gy) or 1.0
        target = (x + travel_m * gx / norm, y + travel_m * gy / norm, self.low_m)
        return move_toward(self.robot, target, self.target_yaw_rad, self.opening)

    def _move_away(self) -> GripperCommand:
        # The tool keeps its height until it is further out. If it rose here, where it descends
        # further out, a learner's mean of the two would hover in between.
        z = self.position[2]
        is_above = z + self.robot.gripper.lowest_tip_m >= self.top_m
        yaw_rad = self.target_yaw_rad if is_above else self.yaw_rad
        target = (*self.behind, min(max(z, self.low_m), self.over_m))
        return move_toward(self.robot, target, yaw_rad, self.opening)

    def _rise(self) -> GripperCommand:
        stays_open = self._is_around() and self.robot.commanded_opening >= IS_OPEN
        return lift(self.over_m - self.position[2], OPEN if stays_open else self.opening)

    def _approach(self) -> GripperCommand:
        target = (*self.behind, self.over_m if self._is_obstacle() else self.low_m)
        return move_toward(self.robot, target, self.target_yaw_rad, self.opening)

    def _can_push(self) -> bool:
        (x, y, z), (bx, by, _), (ux, uy) = self.position, self.body.position, self.direction
        along_m = (x - bx) * ux + (y - by) * uy
        offset_m = abs((y - by) * ux - (x - bx) * uy)
        return (
            z < self.low_m + PUSH_HEIGHT_TOLERANCE_M
            and along_m < -self.body.shape.height_m / 2 + PUSH_OVERLAP_M
            and offset_m < PUSH_OFFSET_M
            and self.turn_rad < PUSH_YAW_RAD
        )

    def _is_obstacle(self) -> bool:
        """Whether the body is in the way of a tool that is not yet behind it."""
        (x, y, _), (bx, by, _), behind = self.position, self.body.position, self.behind
        offset_m = max(abs(behind[0] - x), abs(behind[1] - y))
        if offset_m <= ALIGNED_M and self.turn_rad <= ALIGNED_RAD:
            return False
        least_m = OBSTACLE_SHARE * math.dist(behind, (bx, by))
        return distance_to_segment((bx, by), (x, y), behind) < least_m

    def _is_around(self) -> bool:
        """Whether the fingers may be around the body."""
        return math.dist(self.position[:2], self.body.position[:2]) < footprint_radius_m(self.body)


def push_line(body: Body, goal: tuple[float, float]) -> tuple[float, tuple[float, float]]:
    """Return the distance of a goal from a body, and the unit vector to it."""
    bx, by, _ = body.position
    length_m = math.dist((bx, by), goal)
    if length_m <= 1e-6:
        return length_m, (1.0, 0.0)
    return length_m, ((goal[0] - bx) / length_m, (goal[1] - by) / length_m)


def reach_behind(
    robot: Robot, body: Body, goal: tuple[float, float], workspace: Workspace
) -> float:
    """Return the nearness of the tool to where it pushes a body straight to a goal.

    That is the line from the point of `behind_point` to the surface of the body, at the height and
    with the yaw of a push.
    """
    (bx, by, _), (_, (ux, uy)) = body.position, push_line(body, goal)
    half = min(body.shape.bounds_m[1][:2])
    (x, y, z), _ = robot.tool_pose()
    behind = behind_point(robot, body, (ux, uy), workspace)
    aside_m = distance_to_segment((x, y), behind, (bx - half * ux, by - half * uy))
    above_m = max(z - workspace.z[0] - PUSH_HEIGHT_M - PUSH_HEIGHT_TOLERANCE_M, 0.0)
    across = math.atan2(uy, ux) + math.pi / 2
    return nearness(math.hypot(aside_m, above_m) + turn_m(robot, [across]))


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
