"""Base of the open-loop tasks that place objects in a container."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pybullet

from ba_torchrl.core.actions import PickPlaceCommand
from ba_torchrl.sim.bodies import Body, vertical_extent
from ba_torchrl.sim.geometry import PlanarFrame, Vector, YawPose
from ba_torchrl.sim.meshes import box_mesh, frame_parts, merge_meshes, transform_mesh
from ba_torchrl.sim.shapes import Color, Solid
from ba_torchrl.tasks.base import OpenLoopTask
from ba_torchrl.tasks.body_pool import BodyPool
from ba_torchrl.tasks.manipulation.clearance import half_gap_m
from ba_torchrl.tasks.manipulation.footprints import Rectangle, gaps_m, narrowest, outline
from ba_torchrl.tasks.manipulation.hand_clearance import hand_rectangle, outline_clearances_m
from ba_torchrl.tasks.manipulation.pick_place_commands import place_command
from ba_torchrl.tasks.manipulation.top_down_grasps import TopDownGrasp

SCALE = 0.8
"""Scale at which the objects have the sizes of appendix A.1."""
RELEASE_M = 0.004
"""Displacement of each finger at a release."""
RELEASE_GAP_M = 1e-3
"""Height of an object above its support at its release."""
SUFFICIENT_CLEARANCE_M = 4e-3
"""Clearances above this are equally good."""
YAW_MARGIN_RAD = 1e-4
"""Yaws within this of half a turn count as zero, so that rounding does not matter."""
FILLING_ORDERS = (
    (0, 1, 2, 3, 4, 5),
    (2, 1, 0, 5, 4, 3),
    (3, 4, 5, 0, 1, 2),
    (5, 4, 3, 2, 1, 0),
)
"""Six slots in two rows of three, row by row from each of the four corners."""
UNDERGROUND_M = 0.02
"""Depth of a container's floor below the ground. Fast objects would pass through a thin sheet."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Blocks(Solid):
    """A solid of axis-aligned boxes; collision detection is faster with boxes than with hulls."""

    collision_margin_m: ClassVar[float | None] = None

    def create_collision(self, client: int) -> int:
        """Create one box for each part."""
        corners = [(part.vertices.min(axis=0), part.vertices.max(axis=0)) for part in self.parts]
        return pybullet.createCollisionShapeArray(
            shapeTypes=[pybullet.GEOM_BOX] * len(corners),
            halfExtents=[((high - low) / 2).tolist() for low, high in corners],
            collisionFramePositions=[((high + low) / 2).tolist() for low, high in corners],
            physicsClientId=client,
        )


def open_box(size_m: Vector, wall_m: float, floor_m: float, color: Color) -> Blocks:
    """Return a static box without a lid; the origin is the centre of its bounding box.

    Args:
        size_m: outer extents.
        wall_m: thickness of the walls.
        floor_m: thickness of the floor above the ground.
    """
    x, y, z = size_m
    walls = frame_parts(size_m, wall_m)
    inside = (x - 2 * wall_m, y - 2 * wall_m)
    sheet = transform_mesh(box_mesh((*inside, floor_m)), (0.0, 0.0, (floor_m - z) / 2))
    depth = floor_m + UNDERGROUND_M
    slab = transform_mesh(box_mesh((*inside, depth)), (0.0, 0.0, floor_m - (z + depth) / 2))
    return Blocks(
        parts=(*walls, slab), surface=merge_meshes([*walls, sheet]), mass_kg=0.0, color=color
    )


class PackingTask(OpenLoopTask):
    """A task with objects of a pool on the floor, and a static container."""

    scale_range = (SCALE, SCALE)
    finger_opening = 0.7

    grasp_offsets_m: ClassVar[tuple[float, ...]] = (0.0, 0.008, -0.008, 0.022, -0.022)
    """Distances of the grasps of a long object from its centre at scale `SCALE`, metres."""

    container_m: ClassVar[Vector]
    """Outer extents of the container at scale `SCALE`, metres."""

    container: Body
    pool: BodyPool

    @property
    def unit(self) -> float:
        """Sizes of this episode as a multiple of the appendix's."""
        return self.settings.scale / SCALE

    @property
    def objects(self) -> Sequence[Body]:
        """The objects in the scene."""
        return self.pool.active

    @property
    def landmarks(self) -> Sequence[YawPose]:
        """Poses of objects and container; the workspace's upper corner for inactive objects."""
        corner = self.settings.workspace.upper_corner
        bodies = [*self.pool.active, self.container]
        missing = self.settings.num_objects - len(self.pool.active)
        return [(body.position, body.yaw_rad) for body in bodies] + [(corner, 0.0)] * missing

    def get_state(self) -> Any:
        """Return the indices of the active objects."""
        return self.pool.get_state()

    def set_state(self, state: Any) -> None:
        """Restore the active objects."""
        self.pool.set_state(state)

    def place_height_m(self, top_m: float, xy: tuple[float, float]) -> float:
        """Return the height of the tool at which the held body is just above the highest point."""
        held = self.robot.held_body()
        if held is None:
            return super().place_height_m(top_m, xy)
        return top_m + self.depth_m(held) + RELEASE_GAP_M

    def depth_m(self, held: Body) -> float:
        """Return the distance of the lowest point of the held body below the tool point."""
        return self.robot.tool_pose()[0][2] - vertical_extent(held)[0]

    # -- parts of the experts ----------------------------------------------------------------

    def container_outline(self) -> Rectangle:
        """Return the outline of the container."""
        x, y, _ = self.container.position
        half_x, half_y, _ = (size * self.unit / 2 for size in self.container_m)
        return Rectangle(x, y, self.container.yaw_rad, half_x, half_y)

    def obstacles(self, body: Body | None, above_m: float) -> list[Rectangle]:
        """Return the outlines of the obstacles of the fingers.

        Args:
            body: the body to grasp or release, which is no obstacle.
            above_m: height of the fingertips; lower bodies are no obstacles.
        """
        held = self.robot.held_body()
        return [
            outline(other)
            for other in (*self.pool.active, self.container)
            if other is not body and other is not held and vertical_extent(other)[1] > above_m
        ]

    def grasp(self, body: Body) -> TopDownGrasp:
        """Return the grasp of an object, off its centre if that increases the clearance."""
        return self.equal_grasps(body)[0]

    def equal_grasps(self, body: Body) -> list[TopDownGrasp]:
        """Return the grasp of an object, then grasps of its other sides that are as good."""
        height = self.pick_height_m(vertical_extent(body)[1], body.position[:2])
        gripper = self.robot.gripper
        obstacles = self.obstacles(body, height + self.tips_m)
        hand_obstacles = self.obstacles(body, height + gripper.palm_height_m)
        half_open = half_gap_m(gripper, self.finger_opening)
        sides = [
            (number, PlanarFrame(*side.frame.to_world(0.0, offset * self.unit), side.yaw_rad))
            for number, side in enumerate(self.grasp_sides(body))
            for offset in self.grasp_offsets_m
            if abs(offset * self.unit) <= max(side.half_y - 0.012, 0.0)
        ]
        tools = [tool for _, tool in sides]
        hands = [hand_rectangle(self.robot, tool) for tool in tools]
        clearances_m = np.minimum(
            outline_clearances_m(gripper, tools, half_open, obstacles),
            gaps_m(hands, hand_obstacles).min(axis=1, initial=math.inf),
        )
        capped_m = np.minimum(clearances_m, SUFFICIENT_CLEARANCE_M)
        first: dict[int, int] = {}  # of each side
        for i in np.flatnonzero(capped_m == capped_m.max()).tolist():
            first.setdefault(sides[i][0], i)
        return [
            TopDownGrasp(body, (*tools[i][:2], height), tools[i].yaw_rad, float(clearances_m[i]))
            for i in first.values()
        ]

    def grasp_sides(self, body: Body) -> list[Rectangle]:
        """Return the outlines of an object whose x axes are directions in which fingers close."""
        return narrowest(body, None if self.action_limits.turn_rad else 0.0)

    def place(self, held: Body, position: Vector, turn_rad: float) -> PickPlaceCommand:
        """Return the place of the held body at a position and a yaw up to half turns.

        Args:
            position: final position of its origin.
            turn_rad: rotation about the vertical from its present yaw.
        """
        tool = self.robot.tool_frame()
        yaw = (tool.yaw_rad + turn_rad) % math.pi if self.action_limits.turn_rad else 0.0
        if yaw > math.pi - YAW_MARGIN_RAD:
            yaw = 0.0
        return place_command(tool, held.pose, held.pose.moved_to(position, yaw - tool.yaw_rad))

    @property
    def tips_m(self) -> float:
        """Height of the open fingertips above the tool point, metres."""
        gripper = self.robot.gripper
        return gripper.tip_height_m(self.finger_opening * gripper.half_gap_m)

    def release_half_m(self, held: Body) -> float:
        """Return the distance between the tool point and a finger's inner side at the release."""
        tool, yaw = self.robot.tool_pose()
        around = outline(held, yaw)
        return abs(around.frame.to_local(*tool[:2])[0]) + around.half_x + RELEASE_M
