"""Corner Picking: drag a block out of a corner, then grasp and lift it (appendix A.2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from ba_torchrl.core.actions import GripperCommand, wrap_angle
from ba_torchrl.sim.bodies import Body, vertical_extent
from ba_torchrl.sim.geometry import PlanarFrame, Vector
from ba_torchrl.sim.meshes import box_mesh, transform_mesh
from ba_torchrl.sim.shapes import Box, Color, Solid
from ba_torchrl.tasks.base import TASKS, CloseLoopTask
from ba_torchrl.tasks.instructions import colored
from ba_torchrl.tasks.manipulation.clearance import finger_extent_m
from ba_torchrl.tasks.manipulation.primitives import (
    CLOSED,
    IS_CLOSED,
    IS_OPEN,
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
DRAG_CLEARANCE_M = 10e-3
"""Clearance, at both grasp yaws, at which a drag ends. Open fingers need less, so that no second
drag follows."""
DRAG_GOAL_M = 0.015
"""Target of a drag along both axes of the corner's frame."""
PASSING_CLEARANCE_M = 0.012
"""Gap between the closed fingertips and the block or the walls that they pass over."""
PASSING_TOLERANCE_M = 8e-3
"""Part of that gap that may be missing during the motion."""
PRESS_M = 8e-3
"""Commanded depth of the fingertips below the top of the block. The block stops them, so that they
are on it whatever the error of the command is, down to a heightmap's step of 1.5 mm."""
DRAG_DEPTH = 0.1
"""The same during a drag, as a share of the block's width. Fingers that press harder yield, and
slide over the block."""
ON_BLOCK_M = 6e-3
"""Largest height above the block of closed fingertips that drag it. Fingers that have pressed are
at zero, those that have not are higher."""
DRAG_RAMP_M = 4e-3
"""Difference of height over which the displacement of a drag increases from zero."""
PRESS_TOLERANCE_M = 5e-3
"""Horizontal distance from the press within which the fingers press; from farther they descend to a
gap that increases with the distance."""
WALL_TOLERANCE_M = 3e-3
"""Largest overlap of the closed hand with a wall on its way to the press. The hand slides along a
wall that it touches."""
WAY_SAMPLES = 9
"""Poses of that way that are compared with the walls."""
HAND_MARGIN_M = 0.01
"""Gap wanted between the closed hand and a wall. With more, the press would be farther from the
centre of the block and tilt it."""
BETWEEN_M = 0.02
"""Largest horizontal offset of low open fingers that have the block between them."""
DEPTH_BETWEEN_M = 5e-3
"""Least depth of such fingertips below the top of the block."""


@TASKS.register("close_loop/corner_picking")
class CornerPicking(CloseLoopTask):
    """Objects: a cubic block of 5 cm, flush with two walls of 8 cm on a base of 20 x 20 x 0.2 cm.

    Goal: the block is held and the tool is higher than 15 cm. A finger does not fit between block
    and walls. The base has almost no friction, so that closed fingers that press on the block can
    drag it out. The episode ends early when the block leaves the workspace. Paper, appendix A.2.
    """

    expert_version = 2

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
        """Drag the block out of the corner until a grasp has clearance, then grasp and lift it.

        Closed fingers drag until grasps at both yaws have clearance; open ones grasp.
        """
        robot, block, limits = self.robot, self.block, self.action_limits
        if grasped_body(robot) is block:
            return lift(limits.step_m)
        is_closed = robot.opening() < IS_CLOSED
        yaw = robot.tool_pose()[1]
        nearest = nearest_equivalent_yaw(yaw, block.yaw_rad, limits, math.pi / 2)
        clearance = self.clearance_m(nearest)
        needed = GRASP_CLEARANCE_M
        if is_closed:
            needed = DRAG_CLEARANCE_M
            if limits.turn_rad:
                clearance = min(clearance, self.clearance_m(nearest + math.pi / 2))
        if clearance < needed:
            return self._drag() if self._is_on_block() else self._press()
        x, y, z = block.position
        top = vertical_extent(block)[1]
        if is_closed and self._is_over_block() and self._height_m > -self.block_m / 4:
            # steeply up and without rotation, so that the block does not move along
            above_z = top + self._tips_below_m + PASSING_CLEARANCE_M
            return move_toward(robot, (x, y, max(above_z, robot.tool_pose()[0][2])), yaw, OPEN)
        if self._is_around_block():
            is_low = robot.tool_pose()[0][2] - z <= limits.step_m
            return move_toward(robot, (x, y, z), nearest, CLOSED if is_low else OPEN)
        ceiling = self.settings.workspace.z[1]
        return pick_up(robot, block, limits, yaws_rad=[nearest], ceiling_m=ceiling)

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
        is_closed = self.robot.opening() < IS_CLOSED
        is_near = -self.block_m / 4 < self._height_m < ON_BLOCK_M
        return is_closed and is_near and self._is_over_block()

    def _is_over_block(self) -> bool:
        """Whether the tool is over the block, or beside it within its outline."""
        return self._offset_m() <= self.block_m / 2

    def _offset_m(self) -> float:
        """Return the horizontal offset of the tool from the block, in the frame of the block."""
        frame = PlanarFrame(*self.block.position[:2], self.block.yaw_rad)
        return max(map(abs, frame.to_local(*self.robot.tool_pose()[0][:2])))

    def _is_around_block(self) -> bool:
        """Whether open fingers are low with the block between them."""
        robot = self.robot
        top = vertical_extent(self.block)[1]
        tips_z = robot.tool_pose()[0][2] + robot.gripper.tip_height_m(robot.gripper.half_gap_m)
        is_low = tips_z < top - DEPTH_BETWEEN_M
        return robot.opening() >= IS_OPEN and is_low and self._offset_m() <= BETWEEN_M

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
        """Move above the block with closed fingers, descend and press.

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
        px, py = self.corner.to_world(px, py)
        distance = max(abs(x - px), abs(y - py))
        gap = min(max(distance - PRESS_TOLERANCE_M, 0.0), PASSING_CLEARANCE_M + PRESS_M)
        target = (px, py, top + self._tips_below_m - PRESS_M + gap)
        if robot.opening() < IS_CLOSED and self._is_clear(target, target_yaw):
            if self._height_m < 0 and not self._is_over_block():
                # a low hand would push the block back
                return lift(PASSING_CLEARANCE_M - self._height_m)
            return move_toward(robot, target, target_yaw, CLOSED)
        over_z = wall_top + self._tips_below_m + PASSING_CLEARANCE_M
        if z < over_z - PASSING_TOLERANCE_M:
            return lift(over_z - z, closing(robot))
        return move_toward(robot, (px, py, over_z), target_yaw, closing(robot))

    def _is_clear(self, target: Vector, target_yaw_rad: float) -> bool:
        """Whether the closed hand is clear of the walls on a straight way to a pose.

        At a press on a small block it touches them; the way to it may, too.
        """
        start, yaw = self.robot.tool_pose()
        wall_top = vertical_extent(self.walls)[1]
        turn = wrap_angle(target_yaw_rad - yaw)
        gaps = []
        for part in np.linspace(0.0, 1.0, WAY_SAMPLES).tolist():
            x, y, z = (s + part * (t - s) for s, t in zip(start, target, strict=True))
            reach = self.robot.gripper.closed_reach_m(wall_top - z)
            angle = yaw + part * turn - self.corner.yaw_rad
            gaps.append(self._wall_gap_m(x, y, reach, angle) if reach else math.inf)
        return min(gaps) >= min(gaps[-1], 0.0) - WALL_TOLERANCE_M

    def _wall_gap_m(self, x: float, y: float, hand_half_m: float, turn_rad: float) -> float:
        """Return the gap between the closed hand and the nearer wall.

        Args:
            x: position of the tool, as ``y``.
            hand_half_m: reach of the closed hand along the direction in which it opens.
            turn_rad: yaw of the tool in the corner's frame.
        """
        cos, sin = abs(math.cos(turn_rad)), abs(math.sin(turn_rad))
        half_width = self.robot.gripper.half_width_m
        inner = (self.wall_m - self.base_m) / 2
        x, y = self.corner.to_local(x, y)
        along = x - hand_half_m * cos - half_width * sin
        across = y - hand_half_m * sin - half_width * cos
        return min(along, across) - inner

    def _drag(self) -> GripperCommand:
        """Press on the block and drag it away from both walls, straight towards its target.

        The lower the fingertips, the longer the displacement, until the fingers are on the block.
        """
        goal = self.corner.to_world(
            *(max(b, DRAG_GOAL_M) for b in self.corner.to_local(*self.block.position[:2]))
        )
        dx, dy = (g - b for g, b in zip(goal, self.block.position, strict=False))
        height = self._height_m
        step_m = self.action_limits.step_m * min((ON_BLOCK_M - height) / DRAG_RAMP_M, 1.0)
        share = min(1.0, step_m / max(abs(dx), abs(dy), 1e-6))
        return GripperCommand(
            CLOSED, share * dx, share * dy, -DRAG_DEPTH * self.block_m - height, 0.0
        )

    @property
    def objects(self) -> Sequence[Body]:
        """The block; the walls are static."""
        return (self.block,)
