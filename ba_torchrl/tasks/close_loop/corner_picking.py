"""Corner Picking: drag a block out of a corner, then grasp and lift it (appendix A.2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from ba_torchrl.core.actions import GripperCommand
from ba_torchrl.sim.bodies import Body, vertical_extent
from ba_torchrl.sim.geometry import PlanarFrame
from ba_torchrl.sim.meshes import box_mesh, transform_mesh
from ba_torchrl.sim.shapes import Box, Color, Solid
from ba_torchrl.tasks.base import TASKS, CloseLoopTask
from ba_torchrl.tasks.instructions import colored
from ba_torchrl.tasks.manipulation.clearance import finger_extent_m
from ba_torchrl.tasks.manipulation.primitives import (
    CLOSED,
    IS_CLOSED,
    OPEN,
    closing,
    grasped_body,
    lift,
    move_toward,
    nearest_equivalent_yaw,
)
from ba_torchrl.tasks.manipulation.progress_terms import lift_height, nearness, reach, share, staged
from ba_torchrl.tasks.manipulation.transport import pick_up

WALL_COLOR: Color = (0.72, 0.7, 0.66, 1.0)
BASE_COLOR: Color = (0.86, 0.85, 0.82, 1.0)

SEAM_M = 3e-4
"""Gap between block and walls, wider than the walls' collision margin. Overlapping bodies repel
each other, and the friction of the base is too low to stop the block."""

GRASP_CLEARANCE_M = 2e-3
"""Least clearance of the open fingers for a grasp."""
PASSING_CLEARANCE_M = 0.012
"""Gap between the closed fingertips and the block or the walls that they pass over."""
DRAG_CLEARANCE_M = 15e-3
"""Clearance at which a drag ends, larger than for a grasp so that no second drag follows."""
DRAG_GOAL_M = 0.0
"""Target of a drag along both axes of the corner's frame."""
DRAG_HEIGHT_M = 3e-3
"""Largest height above the block of closed fingertips that press on it and drag it."""
PRESS_M = 4e-3
"""Commanded depth of the fingertips below the top of the block during a drag."""
APPROACH_GAP_M = 5e-4
"""Gap between the fingertips and the block before the drag. From less than a millimetre the
fingers move slowly and do not hit the block."""
APPROACH_TOLERANCE_M = 3e-3
"""Tolerance of the height at the end of the approach."""
PRESS_TOLERANCE_M = 5e-3
"""Tolerance of the horizontal position of the press."""
WALL_GAP_M = 3e-3
"""Gap between the closed hand and a wall that allows a descent beside it. At a press on a small
block the gap is smaller, and that of the press is allowed, less `WALL_TOLERANCE_M`."""
WALL_TOLERANCE_M = 1.5e-3
"""Largest displacement of a low hand towards a wall from the position of such a press."""
HAND_MARGIN_M = 0.01
"""Gap wanted between the closed hand and a wall. With more, the press would be farther from the
centre of the block and tilt it."""


@TASKS.register("close_loop/corner_picking")
class CornerPicking(CloseLoopTask):
    """Objects: a cubic block of 5 cm, flush with two walls of 8 cm on a base of 20 x 20 x 0.2 cm.

    Goal: the block is held and the tool is higher than 15 cm. A finger does not fit between block
    and walls. The base has almost no friction, so that closed fingers that press on the block can
    drag it out. The episode ends early when the block leaves the workspace. Paper, appendix A.2.
    """

    expert_version = 1

    base_m: ClassVar[float] = 0.2
    """Edge of the base, metres."""
    base_height_m: ClassVar[float] = 2e-3
    """Height of the base, metres."""
    base_friction: ClassVar[float] = 1e-3
    """Coefficient of friction of the base."""
    wall_m: ClassVar[float] = 0.02
    """Thickness of the walls, metres."""
    wall_height_m: ClassVar[float] = 0.08
    """Height of the walls at scale 1, metres. It scales with the block, which the hand must reach
    between the walls."""
    lift_height_m: ClassVar[float] = 0.15
    """Least height of the tool at success, metres."""

    def load_scene(self) -> None:
        """Load the block, the base and the walls."""
        self.block = self.world.add(self.cube(), "block")
        size = (self.base_m, self.base_m, self.base_height_m)
        self.base = self.world.add(
            Box(size_m=size, mass_kg=0, friction=self.base_friction, color=BASE_COLOR), "base"
        )
        # centred on the edges of the base; the second wall ends at the first
        edge, wall = self.base_m / 2, self.wall_m
        height = self.wall_height_m * self.settings.scale
        parts = (
            transform_mesh(box_mesh((wall, 2 * edge + wall / 2, height)), (-edge, -wall / 4, 0.0)),
            transform_mesh(box_mesh((2 * edge - wall / 2, wall, height)), (wall / 4, -edge, 0.0)),
        )
        self.walls = self.world.add(Solid(parts=parts, mass_kg=0, color=WALL_COLOR), "walls")

    @property
    def corner(self) -> PlanarFrame:
        """Frame of the corner; its walls are at negative x and y."""
        return PlanarFrame(*self.base.position[:2], self.base.yaw_rad)

    def initialize_episode(self, rng: np.random.Generator) -> None:
        """Place corner and block at a random pose, at least 10 cm from the border."""
        xy = self.random_point(rng, self.base_m)
        self.put_corner(xy, self.random_yaw(rng, 2 * math.pi))

    def put_corner(self, xy: tuple[float, float], yaw_rad: float) -> None:
        """Place the corner at a pose, with the block in it."""
        self.stand(self.base, xy, yaw_rad)
        self.stand(self.walls, xy, yaw_rad)
        flush = (self.wall_m - self.base_m) / 2 + self.block_m / 2 + SEAM_M
        xy = self.corner.to_world(flush, flush)
        z = self.terrain.height_m(xy) + self.base_height_m + self.block_m / 2
        self.block.place((*xy, z), yaw_rad)

    def evaluate(self) -> dict[str, bool]:
        """Return whether the block is held and whether the tool is higher than 15 cm."""
        return {
            "is_grasped": self.robot.held_body() is self.block,
            "is_lifted": self.robot.tool_pose()[0][2] > self.lift_height_m,
        }

    def instruction(self) -> str:
        """Return the instruction with the block's colour."""
        return f"pick up the {colored(self.block, 'block')} from the corner of the two walls"

    def progress(self) -> float:
        """Return the progress in five stages: touch, drag, reach, grasp, lift.

        The first two are complete as soon as open fingers have clearance between block and walls.
        """
        robot, block = self.robot, self.block
        (x, y, z), yaw = robot.tool_pose()
        if robot.held_body() is block:
            low_m = self.settings.workspace.z[0]
            return staged(1.0, 1.0, 1.0, 1.0, lift_height(robot, low_m, self.lift_height_m))
        yaws = [block.yaw_rad + k * math.pi / 2 for k in (0, 1)]
        if not self.action_limits.turn_rad:
            yaws = [yaw]
        # at the start, the surface of the block is at the walls
        start_m = self.block_m / 2 - finger_extent_m(robot.gripper)
        drag = share(max(map(self.clearance_m, yaws)), start_m, GRASP_CLEARANCE_M)
        if drag == 1.0:
            return staged(1.0, 1.0, reach(robot, block, yaws), 0.0, 0.0)
        aside_m = max(math.dist((x, y), block.position[:2]) - self.block_m / 2, 0.0)
        above_m = z - vertical_extent(block)[1] - self._tips_below_m
        return staged(nearness(math.hypot(aside_m, max(above_m, 0.0))), drag, 0.0, 0.0, 0.0)

    def expert_command(self) -> GripperCommand:
        """Drag the block out of the corner until a grasp has clearance, then grasp and lift it."""
        robot, block, limits = self.robot, self.block, self.action_limits
        if grasped_body(robot) is block:
            return lift(limits.step_m)
        yaw = robot.tool_pose()[1]
        is_on_block = self._is_on_block()
        yaws = [
            nearest_equivalent_yaw(yaw, block.yaw_rad + k * math.pi / 2, limits, math.pi)
            for k in (0, 1)
        ]
        needed = DRAG_CLEARANCE_M if is_on_block else GRASP_CLEARANCE_M
        yaws = [wanted for wanted in yaws if self.clearance_m(wanted) >= needed]
        if not yaws:
            return self._drag() if is_on_block else self._press()
        if is_on_block:  # steeply up and without rotation, so that the block does not move along
            x, y, z = block.position
            above_z = z + self.block_m / 2 + self._tips_below_m + PASSING_CLEARANCE_M
            return move_toward(robot, (x, y, above_z), yaw, OPEN)
        ceiling = self.settings.workspace.z[1]
        return pick_up(robot, block, limits, yaws_rad=yaws, ceiling_m=ceiling)

    def clearance_m(self, yaw_rad: float) -> float:
        """Return the clearance between the walls and open fingers around the block, metres."""
        turn = yaw_rad - self.corner.yaw_rad
        along = finger_extent_m(self.robot.gripper)
        across = self.robot.gripper.half_width_m
        cos, sin = abs(math.cos(turn)), abs(math.sin(turn))
        extents = (along * cos + across * sin, along * sin + across * cos)
        position = self.corner.to_local(*self.block.position[:2])
        inner = (self.wall_m - self.base_m) / 2
        outer = inner - self.wall_m
        return min(
            max(b - extent - inner, outer - b - extent)
            for b, extent in zip(position, extents, strict=True)
        )

    def _is_on_block(self) -> bool:
        """Whether closed fingertips are on the block, or just above it."""
        if self.robot.opening() >= IS_CLOSED:
            return False
        frame = PlanarFrame(*self.block.position[:2], self.block.yaw_rad)
        offset = frame.to_local(*self.robot.tool_pose()[0][:2])
        if max(map(abs, offset)) > self.block_m / 2:
            return False
        return -self.block_m / 4 < self._height_m < DRAG_HEIGHT_M

    @property
    def _height_m(self) -> float:
        """Height of the closed fingertips above the top of the block, metres."""
        top = vertical_extent(self.block)[1]
        return self.robot.tool_pose()[0][2] - self._tips_below_m - top

    @property
    def _tips_below_m(self) -> float:
        """Distance of the closed fingertips below the tool point, metres."""
        return -self.robot.gripper.tip_height_m(0.0)

    def _press(self) -> GripperCommand:
        """Move above the block with closed fingers, and descend to it.

        The hand descends while it moves and turns, wherever it is clear of the walls on a straight
        way to the press.
        """
        robot, limits = self.robot, self.action_limits
        (x, y, z), yaw = robot.tool_pose()
        target_yaw = nearest_equivalent_yaw(yaw, self.corner.yaw_rad, limits, math.pi / 2)
        # the hand is wider than the block, so the press is off its centre, away from the wall
        top, wall_top = vertical_extent(self.block)[1], vertical_extent(self.walls)[1]
        gripper = robot.gripper
        hand_half = gripper.closed_reach_m(wall_top - top - self._tips_below_m)
        offset = min(
            hand_half + HAND_MARGIN_M - self.block_m / 2, self.block_m / 2 - gripper.half_width_m
        )
        px, py = self.corner.to_local(*self.block.position[:2])
        turn = target_yaw - self.corner.yaw_rad
        if abs(math.cos(turn)) > 0.7:
            px += offset
        else:
            py += offset
        tool_x, tool_y = self.corner.to_local(x, y)
        gap_now, press_gap = (
            self._wall_gap_m(*xy, hand_half, wanted - self.corner.yaw_rad)
            for *xy, wanted in ((tool_x, tool_y, yaw), (px, py, target_yaw))
        )
        is_clear = gap_now >= min(WALL_GAP_M, press_gap - WALL_TOLERANCE_M)
        low_z = top + self._tips_below_m + APPROACH_GAP_M
        target = self.corner.to_world(px, py)
        distance = max(abs(tool_x - px), abs(tool_y - py))
        if robot.opening() >= IS_CLOSED or not is_clear:
            low_z = wall_top + self._tips_below_m + PASSING_CLEARANCE_M
            if z < low_z - 1e-3:
                return lift(low_z - z, closing(robot))
        elif z < low_z - APPROACH_TOLERANCE_M / 2 and distance > PRESS_TOLERANCE_M:
            return lift(low_z + APPROACH_TOLERANCE_M - z)  # a low hand would push the block back
        return move_toward(robot, (*target, low_z), target_yaw, closing(robot))

    def _wall_gap_m(self, x: float, y: float, hand_half_m: float, turn_rad: float) -> float:
        """Return the gap between the closed hand and the nearer wall.

        Args:
            x: position of the tool in the corner's frame, as ``y``.
            hand_half_m: reach of the closed hand along the direction in which it opens.
            turn_rad: yaw of the tool in the corner's frame.
        """
        cos, sin = abs(math.cos(turn_rad)), abs(math.sin(turn_rad))
        half_width = self.robot.gripper.half_width_m
        inner = (self.wall_m - self.base_m) / 2
        along = x - hand_half_m * cos - half_width * sin
        across = y - hand_half_m * sin - half_width * cos
        return min(along, across) - inner

    def _drag(self) -> GripperCommand:
        """Press on the block and drag it away from both walls, straight towards its target.

        The lower the fingertips, the longer the displacement, up to that of fingers on the block.
        """
        goal = self.corner.to_world(
            *(max(b, DRAG_GOAL_M) for b in self.corner.to_local(*self.block.position[:2]))
        )
        dx, dy = (g - b for g, b in zip(goal, self.block.position, strict=False))
        height = self._height_m
        step_m = self.action_limits.step_m * min((DRAG_HEIGHT_M - height) / DRAG_HEIGHT_M, 1.0)
        share = min(1.0, step_m / max(abs(dx), abs(dy), 1e-6))
        dz = min(-PRESS_M - height, 0.0)
        return GripperCommand(CLOSED, share * dx, share * dy, dz, 0.0)

    @property
    def objects(self) -> Sequence[Body]:
        """The block; the walls are static."""
        return (self.block,)
