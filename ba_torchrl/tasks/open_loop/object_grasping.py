"""Object Grasping: pick any object from a heap in a tray (appendix A.1)."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ba_torchrl.core.actions import PLACE, PickPlaceCommand
from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.geometry import downward_pose
from ba_torchrl.tasks.base import TASKS, OpenLoopTask
from ba_torchrl.tasks.clutter.base import ClutterTask
from ba_torchrl.tasks.clutter.grasp_planner import DEEPEST_M, PIXEL_M, YAWS
from ba_torchrl.tasks.manipulation.footprints import Rectangle
from ba_torchrl.tasks.manipulation.pick_place_commands import pick_command

OBJECT_WIDTH_M = 0.045
"""Assumed width of the object between the fingers, for picks without z."""
PALM_GAP_M = 5e-3
"""Least gap between the palm and the highest point, for picks without z."""
FLOOR_GAP_M = 1.5e-3
"""Least gap between the fingertips and the floor of the tray, for picks without z."""
WINDOW_M = 0.0125
"""Half the width of the window that is searched for the highest point: half a finger's."""
SLIP_COST = 30.0
"""Cost of the slip score of a grasp; fitted to picks of random grasps."""
HEIGHT_ERROR_COST_PER_M = 4500.0
"""Cost of the difference between a grasp's height and the height of a pick without z at its
position; fitted to picks of random grasps."""


@TASKS.register("open_loop/object_grasping")
class ObjectGrasping(ClutterTask, OpenLoopTask):
    """Objects: 1 to 20 random objects in a tray, 15 by default.

    Goal: an object is held. Every episode ends after one pick. Paper, appendix A.1.
    """

    expert_version = 1
    max_steps = 1
    terminates_at_limit = True
    num_objects = 15
    num_objects_range = (1, 20)
    scale_range = (1.0, 1.0)

    def default_max_attempts(self) -> int:
        """Return the number of attempts of the reference implementation, 30."""
        return 30

    def evaluate(self) -> dict[str, bool]:
        """Return whether an object is held."""
        return {"is_grasped": self.robot.held_body() is not None}

    def pick_height_m(self, top_m: float, xy: tuple[float, float]) -> float:
        """Return the height of the tool for a pick without z, metres.

        `DEEPEST_M` and the palm limit the depth below the highest point. The fingertips, which may
        move down as the fingers close, stay above the floor of the tray around an object of
        `OBJECT_WIDTH_M`.
        """
        gripper = self.robot.gripper
        tips_m = gripper.tip_height_m(OBJECT_WIDTH_M / 2)
        depth_m = min(gripper.palm_height_m - PALM_GAP_M, DEEPEST_M + tips_m)
        return max(top_m - depth_m, self.terrain.height_m(xy) + FLOOR_GAP_M - tips_m)

    def window_m(self, held: Body | None) -> float:
        return WINDOW_M

    def expert_command(self) -> PickPlaceCommand:
        """Return the pick with the lowest cost."""
        workspace = self.settings.workspace
        x, y = workspace.center
        if self.grasped_object() is not None:  # the episode is over; the object is placed back
            return PickPlaceCommand(PLACE, x, y, workspace.z[1] / 2)
        heights, tool = self.planner.heights(), ((x, y, workspace.z[1]), 0.0)
        penalty = partial(self._penalty, _highest(heights))
        grasp = self.planner.plan(self.pool.active, tool, self.action_limits, heights, penalty)
        return self._fallback_pick() if grasp is None else pick_command(grasp.tool)

    def _penalty(self, highest: np.ndarray, grasps: np.ndarray) -> np.ndarray:
        """Return the additional costs [N] of grasps.

        Args:
            highest: result of `_highest`.
            grasps: [N, 6] x, y, z, yaw, risk and slip of the planner's grasps.
        """
        pixels = ((grasps[:, :2] - self.planner.corner) / PIXEL_M).astype(int)
        i, j = np.clip(pixels, 0, len(highest) - 1).T
        heights = np.array(
            [
                self.pick_height_m(top, (x, y))
                for top, (x, y) in zip(highest[i, j], grasps[:, :2], strict=True)
            ]
        )
        errors = np.abs(heights - grasps[:, 2])
        return SLIP_COST * grasps[:, 5] + HEIGHT_ERROR_COST_PER_M * errors

    def _fallback_pick(self) -> PickPlaceCommand:
        """Return a pick of the highest object across its least width, the fingers above the floor.

        Even if the grasp fails, the object moves, and may be graspable afterwards.
        """
        samples = (self.planner.placed_samples(body)[:, :3] for body in self.pool.active)
        points = max(samples, key=lambda points: points[:, 2].max())
        yaws = np.arange(YAWS) * np.pi / YAWS if self.action_limits.turn_rad else np.zeros(1)
        across = points[:, :2] @ np.array([np.cos(yaws), np.sin(yaws)])
        yaw = float(yaws[np.ptp(across, axis=0).argmin()])
        gripper, half_m = self.robot.gripper, self.terrain.half_m
        fingers = Rectangle(0.0, 0.0, yaw, gripper.finger_reach_m, gripper.half_width_m)
        reach, center = np.subtract(half_m, fingers.extents_m(0.0)), self.settings.workspace.center
        middle = (points[:, :2].max(axis=0) + points[:, :2].min(axis=0)) / 2
        x, y = np.clip(middle, center - reach, center + reach).tolist()
        return pick_command(
            downward_pose((x, y, self.pick_height_m(points[:, 2].max(), (x, y))), yaw)
        )

    def grasped_object(self) -> Body | None:
        """Return the object that the last pick lifted; it is hidden from the cameras."""
        # not by its contacts, which are known only after a physics step
        return next((body for body in self.pool.active if body.is_hidden), None)


def _highest(heights: np.ndarray) -> np.ndarray:
    """Return the largest of a height image within `WINDOW_M` of each pixel, metres."""
    half = round(WINDOW_M / PIXEL_M)
    for axis in (0, 1):
        padding = [(0, 0), (0, 0)]
        padding[axis] = (half, half)
        padded = np.pad(heights, padding, mode="edge")
        heights = sliding_window_view(padded, 2 * half + 1, axis=axis).max(axis=-1)
    return heights
