"""Object Grasping: take any object out of a heap in a tray (appendix A.2)."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from ba_torchrl.actions import GripperCommand, wrap_angle
from ba_torchrl.sim.bodies import Body
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.close_loop_task import CloseLoopControl
from ba_torchrl.tasks.clutter.base import ClutterTask
from ba_torchrl.tasks.clutter.push_planner import NEAR_M, Push, PushPlanner
from ba_torchrl.tasks.grasps import TopDownGrasp
from ba_torchrl.tasks.motion_primitives import (
    ALIGNED_M,
    ALIGNED_RAD,
    CLOSED,
    OPEN,
    lift,
    move_toward,
)

WALL_PIXELS = 25
"""Border of the planner's height image that shows the tray's walls."""


@TASKS.register("close_loop/object_grasping")
class ObjectGrasping(ClutterTask, CloseLoopControl):
    """Random objects in a tray; success when one is held with the tool 15 cm above ground."""

    num_objects = 5
    num_objects_range = (1, 15)
    fits_tray = True

    lift_height_m: ClassVar[float] = 0.15
    risk_allowed: ClassVar[float] = 1.0
    """Where a grasp is riskier, the expert pushes the object first."""

    def evaluate(self) -> dict[str, bool]:
        """Return whether any object is held and the tool higher than 15 cm."""
        return {"is_grasped": self.robot.held_body() is not None, "is_lifted": self._is_lifted()}

    def expert_command(self) -> GripperCommand:
        """Close the fingers around the object that takes fewest actions, then go up.

        What cannot be grasped as it lies is pushed until it can.
        """
        robot, limits, planner = self.robot, self.action_limits, self.planner
        if robot.opening() < 0.9 and robot.held_body() is not None:
            return lift(limits.step_m)
        heights = planner.heights()
        tool = robot.tool_pose()
        # above everything, the walls' upper parts left out, which the way never crosses
        over_z = float(heights[WALL_PIXELS:-WALL_PIXELS, WALL_PIXELS:-WALL_PIXELS].max())
        over_z = min(over_z + 0.02, self.settings.workspace.z[1])
        grasp = planner.plan(self.clutter.pool.present, tool, limits, heights, self._slip_cost)
        if grasp is None or grasp.risk > self.risk_allowed:
            push = PushPlanner(planner, self.terrain).plan(
                self.clutter.pool.present, tool, limits, heights
            )
            if push is not None:
                return self._push(push, over_z)
        if grasp is None or robot.opening() < 0.9:
            return lift(limits.step_m, OPEN)
        return self._grasp(grasp, over_z)

    def _slip_cost(self, grasps: np.ndarray) -> np.ndarray:
        """Return the actions [N] that it is worth to have an object turn less in the fingers."""
        return grasps[:, 5]

    def _grasp(self, grasp: TopDownGrasp, over_z: float) -> GripperCommand:
        """Go above the object with open fingers, down, and close them on arrival."""
        robot, limits = self.robot, self.action_limits
        (x, y, z), yaw = robot.tool_pose()
        gx, gy, gz = grasp.position
        aside = max(abs(gx - x), abs(gy - y))
        turn = abs(wrap_angle(grasp.yaw_rad - yaw))
        if aside <= ALIGNED_M and turn <= ALIGNED_RAD:
            opening = CLOSED if z - gz <= limits.step_m else OPEN
            return move_toward(robot, grasp.position, grasp.yaw_rad, opening)
        if z < over_z - 1e-3:
            return lift(over_z - z, OPEN)
        return move_toward(robot, (gx, gy, over_z), grasp.yaw_rad, OPEN)

    def _push(self, push: Push, over_z: float) -> GripperCommand:
        """Go down beside an object with closed fingers, then against it."""
        robot = self.robot
        (x, y, z), yaw = robot.tool_pose()
        sx, sy, sz = push.start
        aside = max(abs(sx - x), abs(sy - y))
        is_closed = robot.opening() < 0.1
        if is_closed and z <= sz + push.slack_m and aside <= NEAR_M:
            return move_toward(robot, push.end, yaw, CLOSED)
        if is_closed and aside <= ALIGNED_M:
            return move_toward(robot, push.start, yaw, CLOSED)
        if z < over_z - 1e-3:
            return lift(over_z - z, CLOSED)
        return move_toward(robot, (sx, sy, over_z), yaw, CLOSED)

    def grasped_object(self) -> Body | None:
        """Return the held object if the tool is higher than 15 cm."""
        return self.robot.held_body() if self._is_lifted() else None

    def _is_lifted(self) -> bool:
        return self.robot.tool_pose()[0][2] > self.lift_height_m

    def _is_inside(self, body: Body) -> bool:
        # thin objects lie lower than the workspace begins: the floor bounds them
        workspace = self.settings.workspace
        if self.settings.bounding_box_check:
            (x0, y0, _), (x1, y1, top) = body.bounding_box()
        else:
            x0, y0, top = x1, y1, _ = body.position
        return (
            workspace.x[0] < x0
            and x1 < workspace.x[1]
            and workspace.y[0] < y0
            and y1 < workspace.y[1]
            and math.isfinite(top)
            and top < workspace.z[1]
        )
