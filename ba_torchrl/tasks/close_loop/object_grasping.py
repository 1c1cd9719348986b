"""Object Grasping: grasp and lift any object from a heap in a tray (appendix A.2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from ba_torchrl.core.actions import GripperCommand, wrap_angle
from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.geometry import YawPose
from ba_torchrl.tasks.base import TASKS, CloseLoopTask
from ba_torchrl.tasks.clutter.base import ClutterTask
from ba_torchrl.tasks.clutter.grasp_planner import CLEARANCE_M
from ba_torchrl.tasks.clutter.push_planner import NEAR_M, Push, PushPlanner
from ba_torchrl.tasks.manipulation.primitives import (
    ALIGNED_M,
    CLOSED,
    IS_CLOSED,
    IS_OPEN,
    OPEN,
    closing,
    grasped_body,
    lift,
    move_toward,
)
from ba_torchrl.tasks.manipulation.progress_terms import lift_height, reach, staged
from ba_torchrl.tasks.manipulation.top_down_grasps import TopDownGrasp

RISK_ALLOWED_WITHOUT_YAW = 1.0
"""Largest risk score of a grasp of a gripper that cannot turn and has few grasps; with only riskier
ones, it pushes an object first."""
SLIP = 5
"""Column of the slip in the planner's grasps."""
TURN_OFFSET_M = 0.02
"""Largest horizontal offset, along each axis, of a gripper that turns to a grasp. The image is
centred on the gripper, so a policy sees the object whose orientation matters in its centre."""
GRASP_OFFSET_M = 0.02
"""Largest horizontal offset, along each axis, of a gripper that descends straight to a grasp and
closes. With 4 mm, a policy with errors of a centimetre stays above the object: its next action is
rarely one that descends. A gripper that cannot turn has riskier grasps and aligns first."""
GRASP_TURN_RAD = 0.5
"""Largest yaw error of that gripper."""
WALL_PIXELS = 25
"""Width of the border of the planner's height image that shows the walls of the tray."""


@TASKS.register("close_loop/object_grasping")
class ObjectGrasping(ClutterTask, CloseLoopTask):
    """Objects: 1 to 15 random objects in a tray, five by default.

    Goal: an object is held and the tool is higher than 15 cm. The episode ends early when an object
    leaves the workspace. Paper, appendix A.2.
    """

    num_objects = 5
    num_objects_range = (1, 15)
    fits_tray = True

    lift_height_m: ClassVar[float] = 0.15
    """Least height of the tool at success, metres."""

    def default_max_attempts(self) -> int:
        """Return the number of attempts of the reference implementation, 1.5 per object."""
        return math.ceil(1.5 * self.settings.num_objects)

    def evaluate(self) -> dict[str, bool]:
        """Return whether an object is held and whether the tool is higher than 15 cm."""
        return {"is_grasped": self.robot.held_body() is not None, "is_lifted": self._is_lifted()}

    def progress(self) -> float:
        """Return the progress in three stages: reach to the nearest object, grasp, lift."""
        if self.robot.held_body() is not None:
            low_m = self.settings.workspace.z[0]
            return staged(1.0, 1.0, lift_height(self.robot, low_m, self.lift_height_m))
        return staged(max(reach(self.robot, body) for body in self.objects), 0.0, 0.0)

    def expert_command(self) -> GripperCommand:
        """Grasp the nearest object that can be grasped and lift it; else push one until it can."""
        robot, limits, planner = self.robot, self.action_limits, self.planner
        if grasped_body(robot) is not None:
            return lift(limits.step_m)
        heights = planner.heights()
        tool = robot.tool_pose()
        grasp = self._plan(tool, heights)
        is_risky = not limits.turn_rad and grasp and grasp.risk > RISK_ALLOWED_WITHOUT_YAW
        if grasp is None or is_risky:
            push = PushPlanner(planner, self.terrain).plan(self.pool.active, tool, limits, heights)
            if push is not None:
                return self._push(push, heights)
        if grasp is None or min(robot.opening(), robot.commanded_opening) < IS_OPEN:
            return lift(limits.step_m, OPEN)
        return self._grasp(grasp, heights)

    def _plan(self, tool: YawPose, heights: np.ndarray) -> TopDownGrasp | None:
        """Return the best grasp of the nearest object that has one.

        A policy that imitates the expert predicts which object it grasps: the nearest is visible.
        A gripper that cannot turn has few grasps and takes the best of all objects.
        """

        def best(bodies: Sequence[Body]) -> TopDownGrasp | None:
            return self.planner.plan(
                bodies, tool, self.action_limits, heights, penalty=lambda grasps: grasps[:, SLIP]
            )

        objects = self.pool.active
        if not self.action_limits.turn_rad:
            return best(objects)
        nearest = sorted(objects, key=lambda body: math.dist(body.position[:2], tool[0][:2]))
        return next(filter(None, (best([body]) for body in nearest)), None)

    def _grasp(self, grasp: TopDownGrasp, heights: np.ndarray) -> GripperCommand:
        """Move to the object with open fingers, turn near it, and close them at the end.

        The hand descends while it moves and turns, as far as what is below its way permits.
        """
        robot, limits = self.robot, self.action_limits
        tool = (x, y, z), yaw = robot.tool_pose()
        gx, gy, gz = grasp.position
        offset = max(abs(gx - x), abs(gy - y))
        turn = abs(wrap_angle(grasp.yaw_rad - yaw))
        reach_m = GRASP_OFFSET_M if limits.turn_rad else ALIGNED_M
        if offset <= reach_m and turn <= GRASP_TURN_RAD:
            opening = CLOSED if z - gz <= limits.step_m else OPEN
            return move_toward(robot, grasp.position, grasp.yaw_rad, opening)
        if offset > TURN_OFFSET_M:
            grasp = grasp._replace(yaw_rad=yaw)
        ceiling = self.settings.workspace.z[1]
        touching_z, next_z = (
            min(self.planner.height_on_way(tool, grasp, limits, heights, gap_m), ceiling)
            for gap_m in (0.0, CLEARANCE_M)
        )
        if touching_z > z + limits.step_m:
            return lift(next_z - z, OPEN)
        return move_toward(robot, (gx, gy, next_z), grasp.yaw_rad, OPEN)

    def _push(self, push: Push, heights: np.ndarray) -> GripperCommand:
        """Descend beside an object with closed fingers, then push it."""
        robot = self.robot
        (x, y, z), yaw = robot.tool_pose()
        sx, sy, sz = push.start
        offset = max(abs(sx - x), abs(sy - y))
        is_closed = robot.opening() < IS_CLOSED
        if is_closed and z <= sz + push.height_tolerance_m and offset <= NEAR_M:
            return move_toward(robot, push.end, yaw, CLOSED)
        if is_closed and offset <= ALIGNED_M:
            return move_toward(robot, push.start, yaw, CLOSED)
        # above all objects; the upper parts of the walls are never crossed
        over_z = float(heights[WALL_PIXELS:-WALL_PIXELS, WALL_PIXELS:-WALL_PIXELS].max())
        over_z = min(over_z + 0.02, self.settings.workspace.z[1])
        if z < over_z - 1e-3:
            return lift(over_z - z, closing(robot))
        return move_toward(robot, (sx, sy, over_z), yaw, closing(robot))

    def grasped_object(self) -> Body | None:
        """Return the held object if the tool is higher than 15 cm."""
        return self.robot.held_body() if self._is_lifted() else None

    def _is_lifted(self) -> bool:
        return self.robot.tool_pose()[0][2] > self.lift_height_m
