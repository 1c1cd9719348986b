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
from ba_torchrl.tasks.clutter.grasp_planner import CLEARANCE_M, PIXEL_M
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
"""Largest horizontal offset, along each axis, of a gripper that turns to a grasp as fast as it can;
from twice as far it does not turn. The image is centred on the gripper, so a policy sees the object
whose orientation matters in its centre."""
GRASP_OFFSET_M = 0.02
"""Largest horizontal offset, along each axis, of a gripper that descends straight to a grasp and
closes. With 4 mm, a policy with errors of a centimetre stays above the object: its next action is
rarely one that descends. A gripper that cannot turn has riskier grasps and aligns first."""
GRASP_TURN_RAD = 0.5
"""Largest yaw error of that gripper."""
FAR_COST = 4.0
"""Cost of a grasp beyond these errors. A gripper that has a grasp which is almost as good as the
best one closes, and does not leave it for another one."""
HOVER_M = 0.02
"""Gap between the fingertips and the top of the object above which the gripper moves and turns."""
HOVER_TOLERANCE_M = 0.015
"""Part of that gap that may be missing; a lower gripper rises first."""
HOVER_RAMP_M = 0.01
"""Difference of height over which a rising gripper begins to move and turn."""
LEAST_BETWEEN_M = 0.012
"""Least height above the fingertips of an object that is between the fingers."""
IS_SHUT = 0.1
"""Largest opening of fingers with nothing between them, and of a command to close them fully."""
BETWEEN_SAMPLES = 9
"""Pixels between the fingers that are compared with the height of their tips."""
WALL_PIXELS = 25
"""Width of the border of the planner's height image that shows the walls of the tray."""


@TASKS.register("close_loop/object_grasping")
class ObjectGrasping(ClutterTask, CloseLoopTask):
    """Objects: 1 to 15 random objects in a tray, five by default.

    Goal: an object is held and the tool is higher than 15 cm. The episode ends early when an object
    leaves the workspace. Paper, appendix A.2.
    """

    expert_version = 1
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
        if min(robot.opening(), robot.commanded_opening) < IS_OPEN:
            # fingers that have begun to close continue, whatever has stopped them halfway
            has_begun = min(robot.opening(), robot.commanded_opening) > IS_SHUT
            if has_begun and self._is_between(tool, heights):
                return GripperCommand(CLOSED, 0.0, 0.0, 0.0, 0.0)
            return lift(limits.step_m, OPEN)
        if grasp is None:
            return lift(limits.step_m, OPEN)
        return self._grasp(grasp, heights)

    def _plan(self, tool: YawPose, heights: np.ndarray) -> TopDownGrasp | None:
        """Return the best grasp of the nearest object that has one.

        A policy that imitates the expert predicts which object it grasps: the nearest is visible.
        A gripper that cannot turn has few grasps and takes the best of all objects.
        """

        def costs(grasps: np.ndarray) -> np.ndarray:
            added = grasps[:, SLIP]
            if self.action_limits.turn_rad:
                turn = np.abs(wrap_angle(grasps[:, 3] - tool[1], math.pi))
                offset = np.abs(grasps[:, :2] - tool[0][:2]).max(axis=1)
                added = added + FAR_COST * ((turn > GRASP_TURN_RAD) | (offset > GRASP_OFFSET_M))
            return added

        def best(bodies: Sequence[Body]) -> TopDownGrasp | None:
            return self.planner.plan(bodies, tool, self.action_limits, heights, penalty=costs)

        objects = self.pool.active
        if not self.action_limits.turn_rad:
            return best(objects)
        nearest = sorted(objects, key=lambda body: math.dist(body.position[:2], tool[0][:2]))
        return next(filter(None, (best([body]) for body in nearest)), None)

    def _grasp(self, grasp: TopDownGrasp, heights: np.ndarray) -> GripperCommand:
        """Move and turn above the object with open fingers, descend, and close them at the end.

        A policy that imitates the expert sees from the fingers in the image whether they are
        aligned. Low fingers that are not rise at once: they do not turn beside the object.
        """
        robot, limits = self.robot, self.action_limits
        tool = (x, y, z), yaw = robot.tool_pose()
        gx, gy, gz = grasp.position
        offset = max(abs(gx - x), abs(gy - y))
        turn = wrap_angle(grasp.yaw_rad - yaw)
        reach_m = GRASP_OFFSET_M if limits.turn_rad else ALIGNED_M
        if offset <= reach_m and abs(turn) <= GRASP_TURN_RAD:
            opening = CLOSED if z - gz <= limits.step_m else OPEN
            return move_toward(robot, grasp.position, grasp.yaw_rad, opening)
        ceiling = self.settings.workspace.z[1]
        top = float(self.planner.placed_samples(grasp.body)[:, 2].max())
        hover_z = min(top - robot.gripper.lowest_tip_m + HOVER_M, ceiling)
        touching_z, next_z = (
            min(
                self.planner.height_on_way(
                    tool, grasp._replace(position=(gx, gy, hover_z)), limits, heights, gap_m
                ),
                ceiling,
            )
            for gap_m in (0.0, CLEARANCE_M)
        )
        if touching_z > z + limits.step_m:
            return lift(next_z - z, OPEN)
        share = min(max((z - hover_z + HOVER_TOLERANCE_M) / HOVER_RAMP_M, 0.0), 1.0)
        target = (x + share * (gx - x), y + share * (gy - y), next_z)
        share *= min(max(2 - offset / TURN_OFFSET_M, 0.0), 1.0)
        return move_toward(robot, target, yaw + share * turn, OPEN)

    def _is_between(self, tool: YawPose, heights: np.ndarray) -> bool:
        """Whether an object is between the fingers, above their tips."""
        (x, y, z), yaw = tool
        gripper, planner = self.robot.gripper, self.planner
        half = self.robot.opening() * gripper.half_gap_m / 2
        along = np.linspace(-half, half, BETWEEN_SAMPLES)
        rows, columns = (
            np.clip(((start + along * axis - corner) / PIXEL_M).astype(int), 0, len(heights) - 1)
            for start, axis, corner in zip(
                (x, y), (math.cos(yaw), math.sin(yaw)), planner.corner, strict=True
            )
        )
        return float(heights[rows, columns].max()) > z + gripper.lowest_tip_m + LEAST_BETWEEN_M

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
