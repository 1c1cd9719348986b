"""Corner Picking: nudge a block out of a corner, then grasp and lift it (appendix A.2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from ba_torchrl.actions import GripperCommand, wrap_angle
from ba_torchrl.sim.bodies import Body, vertical_extent
from ba_torchrl.sim.contacts import contacts, gap_m, vertical_force_n
from ba_torchrl.sim.geometry import PlanarFrame
from ba_torchrl.sim.meshes import box_mesh, transform_mesh
from ba_torchrl.sim.shapes import Box, Color, Solid
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.clearance import reach_m
from ba_torchrl.tasks.close_loop_task import CloseLoopTask
from ba_torchrl.tasks.motion_primitives import (
    CLOSED,
    HOVER_M,
    OPEN,
    lift,
    move_toward,
    nearest_equivalent_yaw,
    pick_up,
)

WALL: Color = (0.72, 0.7, 0.66, 1.0)
BASE: Color = (0.86, 0.85, 0.82, 1.0)

SEAM_M = 3e-4
"""Gap between block and walls, wider than the walls' collision margin: bodies that overlap push
each other off, and nothing on the smooth base would stop the block."""

ROOM_M = 2e-3
"""Room beside the open fingers with which a block counts as nudged out."""
DRAG_ROOM_M = 15e-3
"""Room with which a drag ends; more, so that the next look does not start another."""
OUT_M = 0.0
"""A drag leads to this place along both axes of the corner's frame."""
FIRM_N = 2.0
"""Fingers that press this hard take the block along."""
PRESS_M = 5e-3
"""How far below the block's top the fingers are sent to press; the guard stops them earlier."""
NEAR_M = 5e-4
"""Fingers come down to this gap above the block before they press: what starts closer than a
millimetre creeps, and does not hit the block."""
TOUCH_M = 3e-3
"""Tolerance of the height at which the approach ends."""
PRESS_ASIDE_M = 5e-3
"""The place to press on is met within this distance."""
PRESS_TURN_RAD = 0.15
"""The fingers stand along a wall within this angle."""
WALL_GAP_M = 1.5e-3
"""The low hand comes this much closer to a wall than where it presses, and no more."""
HAND_MARGIN_M = 0.01
"""Gap wanted between the closed hand and a wall beside it; with more, the press would be farther
from the block's middle and tilt it."""


@TASKS.register("close_loop/corner_picking")
class CornerPicking(CloseLoopTask):
    """A 5 cm block flush with two walls; success when it is held with the tool 15 cm above ground.

    The walls stand over two edges of a smooth square base; their height goes with the block's, or
    the hand would not reach down to a small one. Between block and walls there is no room for a
    finger; pressed from above, the block slides out.
    """

    base_m: ClassVar[float] = 0.2
    base_height_m: ClassVar[float] = 2e-3
    base_friction: ClassVar[float] = 1e-3
    wall_m: ClassVar[float] = 0.02
    wall_height_m: ClassVar[float] = 0.08
    lift_height_m: ClassVar[float] = 0.15

    def load_scene(self) -> None:
        """Load the block, the base and the walls."""
        self.block = self.world.add(self.cube(), "block")
        size = (self.base_m, self.base_m, self.base_height_m)
        self.base = self.world.add(
            Box(size_m=size, mass_kg=0, friction=self.base_friction, color=BASE), "base"
        )
        # centred on the edges of the base; the second wall ends at the first
        edge, wall = self.base_m / 2, self.wall_m
        height = self.wall_height_m * self.settings.scale
        parts = (
            transform_mesh(box_mesh((wall, 2 * edge + wall / 2, height)), (-edge, -wall / 4, 0.0)),
            transform_mesh(box_mesh((2 * edge - wall / 2, wall, height)), (wall / 4, -edge, 0.0)),
        )
        self.walls = self.world.add(Solid(parts=parts, mass_kg=0, color=WALL), "walls")

    @property
    def corner(self) -> PlanarFrame:
        """Frame of the corner; its walls are at negative x and y."""
        return PlanarFrame(*self.base.position[:2], self.base.yaw_rad)

    def initialize_episode(self, rng: np.random.Generator) -> None:
        """Put the corner anywhere, 10 cm from the border, with the block in it."""
        xy = self.random_point(rng, self.base_m)
        self.put_corner(xy, self.random_yaw(rng, 2 * math.pi))

    def put_corner(self, xy: tuple[float, float], yaw_rad: float) -> None:
        """Put the corner at a pose, with the block in it."""
        self.stand(self.base, xy, yaw_rad)
        self.stand(self.walls, xy, yaw_rad)
        flush = (self.wall_m - self.base_m) / 2 + self.block_m / 2 + SEAM_M
        xy = self.corner.to_world(flush, flush)
        z = self.terrain.height_m(xy) + self.base_height_m + self.block_m / 2
        self.block.place((*xy, z), yaw_rad)

    def evaluate(self) -> dict[str, bool]:
        """Return whether the block is held and the tool higher than 15 cm."""
        return {
            "is_grasped": self.robot.held_body() is self.block,
            "is_lifted": self.robot.tool_pose()[0][2] > self.lift_height_m,
        }

    def expert_command(self) -> GripperCommand:
        """Nudge the block out of the corner until fingers fit beside it, then grasp and lift it."""
        robot, block, limits = self.robot, self.block, self.action_limits
        if robot.held_body() is block and robot.opening() < 0.9:
            return lift(limits.step_m)
        yaw = robot.tool_pose()[1]
        touching = contacts(self.world.client, robot.id, block.id)
        is_pressing = robot.opening() < 0.5 and vertical_force_n(touching) > FIRM_N
        yaws = [
            nearest_equivalent_yaw(yaw, block.yaw_rad + k * math.pi / 2, limits, math.pi)
            for k in (0, 1)
        ]
        needed = DRAG_ROOM_M if is_pressing else ROOM_M
        yaws = [wanted for wanted in yaws if self.clearance_m(wanted) >= needed]
        if not yaws:
            return self._pull() if is_pressing else self._press()
        if is_pressing:  # no turn yet, and steeply up: else the fingers would take the block along
            x, y, z = block.position
            return move_toward(
                robot, (x, y, z + self.block_m / 2 + self._tips_below_m + HOVER_M), yaw, OPEN
            )
        ceiling = self.settings.workspace.z[1]
        return pick_up(robot, block, limits, yaws_rad=yaws, ceiling_m=ceiling)

    def clearance_m(self, yaw_rad: float) -> float:
        """Return the gap between open fingers around the block and the walls.

        Args:
            yaw_rad: the gripper's; the gap is in metres, negative where there is none.
        """
        turn = yaw_rad - self.corner.yaw_rad
        along = reach_m(self.robot.gripper)
        across = self.robot.gripper.half_width_m
        cos, sin = abs(math.cos(turn)), abs(math.sin(turn))
        extents = (along * cos + across * sin, along * sin + across * cos)
        place = self.corner.to_local(*self.block.position[:2])
        inner = (self.wall_m - self.base_m) / 2
        outer = inner - self.wall_m
        return min(
            max(b - extent - inner, outer - b - extent)
            for b, extent in zip(place, extents, strict=True)
        )

    @property
    def _tips_below_m(self) -> float:
        """How far below the tool point the closed fingers end."""
        return -self.robot.gripper.tip_height_m(0.0)

    def _press(self) -> GripperCommand:
        """Go over the block with closed fingers, come down to it, and press."""
        robot, limits = self.robot, self.action_limits
        (x, y, z), yaw = robot.tool_pose()
        target_yaw = nearest_equivalent_yaw(yaw, self.corner.yaw_rad, limits, math.pi / 2)
        turn = wrap_angle(target_yaw - yaw)
        # the hand is wider than the block along the fingers, and has the wall beside it
        top, wall_top = vertical_extent(self.block)[1], vertical_extent(self.walls)[1]
        gripper = robot.gripper
        hand_half = gripper.closed_reach_m(wall_top - top - self._tips_below_m) + HAND_MARGIN_M
        away = min(hand_half - self.block_m / 2, self.block_m / 2 - gripper.half_width_m)
        px, py = self.corner.to_local(*self.block.position[:2])
        if abs(math.cos(target_yaw - self.corner.yaw_rad)) > 0.7:
            px += away
        else:
            py += away
        tool_x, tool_y = self.corner.to_local(x, y)
        low_z = top + self._tips_below_m + NEAR_M
        aside = max(abs(tool_x - px), abs(tool_y - py))
        is_clear = min(tool_x - px, tool_y - py) > -WALL_GAP_M and abs(turn) < PRESS_TURN_RAD
        target = self.corner.to_world(px, py)
        if robot.opening() < 0.1 and aside < PRESS_ASIDE_M and is_clear:
            gap = gap_m(self.world.client, robot.id, self.block.id)
            if gap <= 2 * NEAR_M:
                return lift(-PRESS_M)
            if gap <= limits.step_m:
                return lift(NEAR_M - gap)
        if z < low_z - TOUCH_M / 2 and aside > PRESS_ASIDE_M:
            return lift(low_z + TOUCH_M - z)  # not from the side: that pushes the block back
        if not is_clear or robot.opening() >= 0.1:
            low_z = wall_top + self._tips_below_m + HOVER_M
            if z < low_z - 1e-3:
                return lift(low_z - z)
        return move_toward(robot, (*target, low_z), target_yaw, CLOSED)

    def _pull(self) -> GripperCommand:
        """Drag the block away from both walls, straight towards its place."""
        goal = self.corner.to_world(
            *(max(b, OUT_M) for b in self.corner.to_local(*self.block.position[:2]))
        )
        dx, dy = (g - b for g, b in zip(goal, self.block.position, strict=False))
        share = min(1.0, self.action_limits.step_m / max(abs(dx), abs(dy), 1e-6))
        return GripperCommand(CLOSED, share * dx, share * dy, 0.0, 0.0)

    @property
    def objects(self) -> Sequence[Body]:
        """The block; the corner is fixed."""
        return (self.block,)
