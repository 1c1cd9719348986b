"""Assembling: the close-loop expert of the tasks that build a structure."""

from __future__ import annotations

import math
from functools import cache

from ba_torchrl.actions import GripperCommand
from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.robots.base import Robot
from ba_torchrl.tasks.base import ActionLimits, Workspace
from ba_torchrl.tasks.motion_primitives import (
    OPEN,
    carry_to,
    finger_room,
    lift,
    nearest_equivalent_yaw,
    pick_up,
)
from ba_torchrl.tasks.structures.free_space import PlacementArea
from ba_torchrl.tasks.structures.planner import StructurePlanner

NO_ROOM_M = 1.0
"""A piece between others is worth this much of a detour."""


def assemble(
    robot: Robot,
    planner: StructurePlanner,
    workspace: Workspace,
    limits: ActionLimits,
    surface_z_m: float = 0.0,
) -> GripperCommand:
    """Build a structure: pick the piece that comes next and place it, from any state.

    Args:
        robot: the robot.
        planner: what is to be built.
        workspace: where pieces may be put down.
        limits: of an action.
        surface_z_m: height of the ground.
    """
    (x, y, _), yaw = robot.tool_pose()
    held = robot.held_body() if robot.opening() < 0.9 else None
    pieces = list(planner.pieces)

    def yaws(body: Body) -> list[float]:
        return planner.pieces[body].grasp_yaws(body) if limits.turn_rad else [yaw]

    @cache
    def effort(body: Body) -> float:
        others = [other for other in pieces if other is not body]
        room = max(finger_room(robot, body, option, others) for option in yaws(body))
        return math.dist((x, y), body.position[:2]) + (0.0 if room > 0 else NO_ROOM_M)

    border = 1.2 * planner.block_m
    area = PlacementArea(
        (workspace.x[0] + border, workspace.x[1] - border),
        (workspace.y[0] + border, workspace.y[1] - border),
        gap_m=planner.block_m,
        z_m=surface_z_m,
    )
    move = planner.next_move(area, held, effort)
    if move is None:
        return lift(limits.step_m, OPEN)
    ceiling_m = workspace.z[1]
    if move.body is not held:
        return pick_up(
            robot,
            move.body,
            limits,
            yaws_rad=yaws(move.body),
            obstacles=pieces,
            ceiling_m=ceiling_m,
        )
    target_yaw = None
    if move.yaw_rad is not None:
        ahead = move.yaw_rad - move.piece.yaw_rad(held)
        target_yaw = nearest_equivalent_yaw(yaw, yaw + ahead, limits, move.yaw_period_rad)
    return carry_to(
        robot,
        held,
        move.position,
        limits,
        yaw_rad=target_yaw,
        obstacles=pieces,
        ceiling_m=ceiling_m,
    )
