"""Object Grasping: take any object out of a heap in a tray (appendix A.1)."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ba_torchrl.actions import PLACE, PickPlaceCommand
from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.geometry import downward_pose
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.clutter.base import ClutterTask
from ba_torchrl.tasks.clutter.grasp_planner import DEEPEST_M, PIXEL_M, YAWS
from ba_torchrl.tasks.open_loop_task import OpenLoopControl
from ba_torchrl.tasks.pick_place_commands import pick_command

USUAL_WIDTH_M = 0.045
"""Of an object between the fingers, where an action leaves the height open."""
PALM_GAP_M = 5e-3
FLOOR_GAP_M = 1.5e-3
"""Distances that palm and fingertips then keep."""
WINDOW_M = 0.0125
"""Half the fingers' width: what is searched for the highest point lies between them."""
SLIP_COST = 30.0
MISFIT_COST_PER_M = 4500.0
"""What the expert fears: that an object turns and slips out, and a height, where the action leaves
it open, that is not the one which the grasp was found for. Fitted to picks of random grasps."""
NEAR_COST = 60.0
"""After a failure the expert takes the next grasp, unless it costs this much more."""


@TASKS.register("open_loop/object_grasping")
class ObjectGrasping(ClutterTask, OpenLoopControl):
    """Random objects in a tray, 15 unless told otherwise; success when a pick took one.

    An episode is one pick.
    """

    max_steps = 1
    terminates_at_limit = True
    num_objects = 15
    num_objects_range = (1, 20)
    scale_range = (1.0, 1.0)

    def evaluate(self) -> dict[str, bool]:
        """Return whether an object is held."""
        return {"is_grasped": self.robot.held_body() is not None}

    def pick_height_m(self, top_m: float, xy: tuple[float, float]) -> float:
        """Return the height of the tool for a pick, where an action leaves it open.

        The fingers reach around the object as far as they are of use; the palm stays above it, and
        the fingertips above the tray's floor when they meet an object of usual width: some swing
        down as they close.

        Args:
            top_m: height of the highest point around the target, metres.
            xy: of the target.
        """
        gripper = self.robot.gripper
        tips_m = gripper.tip_height_m(USUAL_WIDTH_M / 2)
        depth_m = min(gripper.palm_height_m - PALM_GAP_M, DEEPEST_M + tips_m)
        return max(top_m - depth_m, self.terrain.height_m(xy) + FLOOR_GAP_M - tips_m)

    def window_m(self, held: Body | None) -> float:
        """Return half the width of the square that is searched for the highest point."""
        return WINDOW_M

    def expert_command(self) -> PickPlaceCommand:
        """Pick what is least likely to slip; after failures, what comes next if it is near."""
        workspace = self.settings.workspace
        x, y = workspace.center
        if (
            self.grasped_object() is not None
        ):  # the episode is over: all that is left is to put it back
            return PickPlaceCommand(PLACE, x, y, workspace.z[1] / 2)
        planner, present = self.planner, self.clutter.pool.present
        heights, tool = planner.heights(), ((x, y, workspace.z[1]), 0.0)
        penalty = partial(self._penalty, _highest(heights))
        grasps = [planner.plan([b], tool, self.action_limits, heights, penalty) for b in present]
        found = sorted(filter(None, grasps), key=lambda grasp: grasp.cost)
        if not found:
            return self._squeeze()
        near = [grasp for grasp in found if grasp.cost < found[0].cost + NEAR_COST]
        grasp = near[self.clutter.failures % len(near)]
        return pick_command(grasp.tool)

    def _penalty(self, highest: np.ndarray, grasps: np.ndarray) -> np.ndarray:
        """Return what speaks against grasps [N, 6] as the planner lists them, [N].

        Args:
            highest: from `_highest`.
            grasps: x, y, z, yaw, risk and slip.
        """
        pixels = ((grasps[:, :2] - self.planner.corner) / PIXEL_M).astype(int)
        i, j = np.clip(pixels, 0, len(highest) - 1).T
        heights = np.array(
            [
                self.pick_height_m(top, (x, y))
                for top, (x, y) in zip(highest[i, j], grasps[:, :2], strict=True)
            ]
        )
        misfit = np.abs(heights - grasps[:, 2])
        return SLIP_COST * grasps[:, 5] + MISFIT_COST_PER_M * misfit

    def _squeeze(self) -> PickPlaceCommand:
        """Close on what reaches highest, after failures on what comes next: held or not, it moves.

        The fingers close across its narrowest side.
        """
        samples = [self.planner.placed_samples(body)[:, :3] for body in self.clutter.pool.present]
        samples.sort(key=lambda points: points[:, 2].max(), reverse=True)
        points = samples[self.clutter.failures % len(samples)]
        yaws = np.arange(YAWS) * np.pi / YAWS if self.action_limits.turn_rad else np.zeros(1)
        across = points[:, :2] @ np.array([np.cos(yaws), np.sin(yaws)])
        x, y = (points[:, :2].max(axis=0) + points[:, :2].min(axis=0)) / 2
        z = self.pick_height_m(points[:, 2].max(), (float(x), float(y)))
        yaw = yaws[np.ptp(across, axis=0).argmin()]
        return pick_command(downward_pose((float(x), float(y), float(z)), float(yaw)))

    def grasped_object(self) -> Body | None:
        """Return what the last pick took: cameras do not see it; contacts wait for a step."""
        return next((body for body in self.clutter.pool.present if body.is_hidden), None)


def _highest(heights: np.ndarray) -> np.ndarray:
    """Return for each pixel of the planner's image the highest within `WINDOW_M`, metres."""
    half = round(WINDOW_M / PIXEL_M)
    for axis in (0, 1):
        padding = [(0, 0), (0, 0)]
        padding[axis] = (half, half)
        padded = np.pad(heights, padding, mode="edge")
        heights = sliding_window_view(padded, 2 * half + 1, axis=axis).max(axis=-1)
    return heights
